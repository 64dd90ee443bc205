"""`polypod schema` and the page of all keys say what the parsers take."""

import copy
import json
import re
import subprocess
import sys

import jsonschema
import pytest

import polypod
from common import ROOT
from polypod import ConfigError
from polypod.cli import main
from polypod.commands.schema import read
from polypod.compat import tomllib
from polypod.motions import key_poses, options, tracking
from polypod.runs import config
from polypod.training.sweep import SweepFile

FOLDERS = {"task": "tasks", "robot": "robots", "train": "train"}
MOTIONS = ROOT / "python" / "polypod" / "motions"
SCHEMAS = {kind: read(kind) for kind in (*FOLDERS, "tracking", "motion", "sweep")}
CHECKS = {kind: jsonschema.Draft7Validator(schema) for kind, schema in SCHEMAS.items()}
FILES = [
    (kind, path) for kind, folder in FOLDERS.items() for path in sorted((ROOT / "configs" / folder).glob("*.toml"))
]
FILES += [("tracking", MOTIONS / "tracking.toml"), *(("motion", path) for path in sorted(MOTIONS.glob("drawn/*.toml")))]
TABLES = {
    "SimConfig": "sim",
    "PhysicsConfig": "physics",
    "SceneConfig": "scene",
    "GroundConfig": "scene.ground",
    "TerrainConfig": "scene.terrain",
    "MaterialConfig": "robot_material",
    "VelocityCommandConfig": "commands.base_velocity",
    "SensorsConfig": "sensors",
    "HeightScannerConfig": "sensors.height_scanner",
    "RobotConfig": "robot_overrides.unitree_go2",
    "ActuatorConfig": "robot_overrides.unitree_go2.actuators.legs",
    "CommandLimitsConfig": "robot_overrides.unitree_go2.commands",
    "VelocityLimitsConfig": "robot_overrides.unitree_go2.commands.base_velocity",
    "ResetConfig": "robot_overrides.unitree_go2.reset",
    "JointPositionReset": "robot_overrides.unitree_go2.reset.joint_position",
    "RandomizationConfig": "robot_overrides.unitree_go2.randomization",
    "BaseComOffset": "robot_overrides.unitree_go2.randomization.base_com_offset",
    "Draw": "robot_overrides.unitree_go2.randomization.stiffness",
    "VariationConfig": "robot_overrides.unitree_go2.variation",
    "BodiesConfig": "robot_overrides.unitree_go2.bodies",
}
"""Tables of a task and of its robots by their definitions."""


def test_the_schemas_are_what_the_sources_say():
    line = [sys.executable, str(ROOT / "tools" / "schemas.py"), "--check"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda of: getattr(of, "stem", of))
def test_a_shipped_file_is_valid_and_a_wrong_key_in_it_is_not(kind, path):
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    assert [error.message for error in CHECKS[kind].iter_errors(tables)] == []
    # tables that a person names take any key
    for key in ("", *(key for key, value in tables.items() if isinstance(value, dict) and key in SECTIONS[kind])):
        wrong = copy.deepcopy(tables)
        (wrong[key] if key else wrong)["zzz"] = 1
        assert not CHECKS[kind].is_valid(wrong), key


SECTIONS = {
    "task": ("sim", "physics", "scene", "robot_material", "sensors"),
    "robot": ("commands", "reset", "randomization", "variation", "bodies"),
    "train": tuple(config.SECTIONS),
    "tracking": ("rewards", "terminations", "reset", "sampling"),
    "motion": (),
}


@pytest.mark.parametrize("name", sorted(TABLES))
def test_keys_are_those_that_the_parser_takes(name):
    override = f"{TABLES[name]}.zzz=1"
    with pytest.raises(ConfigError) as caught:
        # robots of a task are read when it is made
        polypod.make("velocity_rough", 1, robots=["unitree_go2"], overrides=[override]).close()
    known = re.search(r"known keys: (.*) \(see `polypod (?:terms|show` and `polypod schema)`\)$", str(caught.value))
    assert known, caught.value
    found = {key.strip(" .`") for key in known[1].split(",")}
    assert found == set(SCHEMAS["task"]["definitions"][name]["properties"]), caught.value


def test_all_keys_of_a_train_config_are_in_the_schema():
    for section, type_ in config.SECTIONS.items():
        assert set(SCHEMAS["train"]["properties"][section]["properties"]) == set(type_.__dataclass_fields__)


def described(schema, place):
    """All keys of a schema with what is said of them."""
    if isinstance(schema, list):
        for inner in schema:
            yield from described(inner, place)
    elif isinstance(schema, dict):
        for key, value in schema.get("properties", {}).items() if "type" in schema else ():
            yield f"{place}.{key}", key, value
        for key, value in schema.items():
            yield from described(value, f"{place}.{key}")


def test_keys_of_motions_and_sweeps_are_those_that_the_parser_takes():
    for kind, type_ in (("tracking", options.Options), ("motion", key_poses.Drawing), ("sweep", SweepFile)):
        tables = {type_.__name__: SCHEMAS[kind], **SCHEMAS[kind]["definitions"]}
        for name, schema in tables.items():
            of = getattr(sys.modules[type_.__module__], name)
            assert set(schema["properties"]) == set(of.__struct_fields__), name
            assert of.__struct_config__.forbid_unknown_fields, name
    named = {kind: set(SCHEMAS["tracking"]["properties"][kind]["properties"]) for kind in ("rewards", "terminations")}
    assert named == {"rewards": set(tracking.ERRORS), "terminations": set(tracking.DEVIATIONS)}
    declared = tracking.declared(options.options(), ["unitree_g1"])
    assert {*declared.rewards, *declared.terminations, *declared.observations} == set(options.TERMS)


@pytest.mark.parametrize("kind", sorted(SCHEMAS))
def test_every_key_is_described_and_on_the_page(kind):
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import reference
    finally:
        sys.path.pop(0)
    page = reference.page()
    keys = list(described(SCHEMAS[kind], kind))
    assert len(keys) > (40 if kind in FOLDERS else 10)
    for place, key, schema in keys:
        # stages are described as a whole
        if "velocity_stages.items" not in place:
            assert len(schema.get("description", "")) >= 3, place
        assert f"{key}`" in page, place
    for anchor in set(re.findall(r"\]\(#([\w-]+)\)", page)):
        assert re.search(rf"^#+ {anchor}$", page.replace("`", ""), re.MULTILINE | re.IGNORECASE), anchor


def test_the_command_prints_a_schema(capsys):
    assert main(["schema", "robot"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMAS["robot"]
    with pytest.raises(SystemExit, match="2"):
        main(["schema", "world"])
