"""`polypod terms` says of every term what the parser takes."""

import json
import re
import subprocess
import sys

import pytest

import polypod
from common import ROOT
from polypod import ConfigError, _core, term_list
from polypod.cli import main

TERMS = term_list.read()
PLACES = {
    "rewards": "rewards.unitree.{entry}",
    "terminations": "terminations.{entry}",
    "events": "events.{entry}",
    "curricula": "curriculum.{entry}",
    "commands": "commands.{entry}",
    "observations": "observations.policy",
}
OF_ALL = {
    "rewards": {"term", "weight", "enabled"},
    "terminations": {"term", "enabled", "time_out"},
    "events": {"term", "mode", "enabled", "interval_range_s"},
    "curricula": {"term", "enabled"},
    "commands": {"term", "enabled", "resampling_time_s"},
    "observations": {"term", "noise", "error", "clip", "scale", "history_length", "external"},
}
"""Keys of all terms of a kind."""


COMMANDS = {
    "foot_placement": "{}",
    "gait": "{frequency = [1.0, 2.0]}",
    "heading": "{}",
    "jump": "{time = [0.5, 1.0]}",
    "pose": "{}",
    "position": "{pos_x = [0.0, 1.0], pos_y = [0.0, 1.0]}",
}
"""Commands that terms follow."""


def complaint(kind, name, keys):
    """The error about a term with these keys; None where it is taken."""
    # entries of rewards and curricula may be named otherwise
    is_aliased = kind in ("rewards", "curricula")
    place = PLACES[kind].format(entry="tried" if is_aliased else name)
    table = {"term": name} if is_aliased else {}
    if kind == "rewards":
        table["weight"] = 1.0
    if kind == "events":
        mode = TERMS[kind][name]["modes"].split(", ")[0]
        table |= {"enabled": True, "mode": mode, **({"interval_range_s": [1.0, 2.0]} if mode == "interval" else {})}
    entry = [{"term": name} | keys] if kind == "observations" else table | keys
    text = json.dumps(entry).replace('": ', '" = ')
    others = [f"commands.{command}={text}" for command, text in COMMANDS.items() if command != name]
    others += ["sensors.height_scanner={size=[0.2, 0.2], resolution=0.1}"]
    camera = "mount={pos=[0.3, 0.0, 0.1]}, pattern_cfg={width=2, height=2, horizontal_fov=1.5}, max_distance=3.0"
    others += [f"sensors.ray_caster_camera={{{camera}}}"]
    try:
        polypod.make(
            "velocity_flat", 1, robots=["unitree_go2"], threads=1, overrides=[*others, f"{place}={text}"]
        ).close()
    except ConfigError as error:
        return str(error)
    return None


def names_of(kind):
    return sorted(TERMS[kind])


def test_the_list_is_what_the_sources_say():
    line = [sys.executable, str(ROOT / "tools" / "terms.py"), "--check"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ("rewards", "rewards.unitree.zzz={weight=1.0}"),
        ("terminations", "terminations.zzz={}"),
        ("events", "events.zzz={mode='startup'}"),
        ("curricula", "curriculum.zzz={}"),
        ("commands", "commands.zzz={}"),
    ],
)
def test_the_list_has_the_names_that_the_parser_knows(kind, place):
    with pytest.raises(ConfigError) as caught:
        polypod.make("velocity_flat", 1, robots=["unitree_go2"], overrides=[place])
    known = re.search(r"known [\w ]+: (.*) \(see `polypod terms`\)$", str(caught.value))
    assert known, caught.value
    found = {name.strip(" .") for name in known[1].split(",")}
    if kind == "events":
        assert found <= set(TERMS[kind])
        assert found >= {name for name in TERMS[kind] if "startup" in TERMS[kind][name]["modes"]}
    else:
        assert found == set(TERMS[kind]) - {"illegal_state"}


def test_observations_and_commands_are_the_registrys():
    assert set(TERMS["observations"]) == set(json.loads(_core.observation_specs()))
    assert set(TERMS["commands"]) == set(json.loads(_core.command_specs()))


@pytest.mark.parametrize("kind", sorted(PLACES))
def test_parameters_are_those_that_the_parser_takes(kind):
    """An unknown key is refused with the known ones, where there are any."""
    for name in names_of(kind):
        said = complaint(kind, name, {"zzz": 1.0})
        assert said is not None, name
        parameters = {parameter["name"] for parameter in TERMS[kind][name]["parameters"]}
        known = re.search(r"known keys: (.*?)(?: \(see .*)?$", said)
        if known is None:
            assert "there are no keys here" in said, said
            assert parameters <= OF_ALL[kind], f"{name}: {said}"
            continue
        found = {key.strip(" .`") for key in known[1].split(",")} - OF_ALL[kind]
        assert found == parameters - OF_ALL[kind], f"{name}: {said}"


def test_everything_is_described():
    for kind, terms in TERMS.items():
        for name, term in terms.items():
            assert len(term["description"]) > 8, f"{kind}: {name}"
            for parameter in term["parameters"]:
                assert len(parameter["description"]) > 8, f"{kind}: {name}.{parameter['name']}"
                assert not re.match(r"[A-Z]|.*<", parameter["type"]), f"{kind}: {name}.{parameter['name']}"


def test_the_command_prints_them(capsys):
    assert main(["terms"]) == 0
    printed = capsys.readouterr().out
    for terms in TERMS.values():
        assert all(f"  {name} " in printed for name in terms)
    assert main(["terms", "foot_clearance"]) == 0
    printed = capsys.readouterr().out
    assert "target_height: number, m; required. Height of a swinging foot's centre" in printed
    assert main(["terms", "--kind", "events", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["events"]) == set(TERMS["events"])
    assert main(["terms", "foot_clearence"]) == 2
    assert "did you mean 'foot_clearance'?" in capsys.readouterr().err
    assert main(["terms", "foot_clearance", "--kind", "events"]) == 2
    assert "no term 'foot_clearance' of events" in capsys.readouterr().err


def test_the_terms_of_a_file_are_listed_with_what_they_declare(capsys, tmp_path):
    file = ROOT / "examples" / "jump_task.py"
    assert main(["terms", "--terms", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    kinds = {line for line in lines if not line.startswith(" ")}
    assert kinds == {*TERMS, "metrics", "memories"} - {"tracking"}
    names = {line.split()[0] for line in lines if line.startswith(" ")}
    assert names >= {"reach_height", "clock", "too_low", "nudge", "jump_height", "higher", "height_error", "phase"}
    assert main(["terms", "clock", "--terms", str(file)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("clock, one of observations: Sine and cosine of the phase of the jump.\n")
    assert "  size = 2\n  history_length = 3\n" in printed
    line = next(i for i, text in enumerate(file.read_text().splitlines(), 1) if text.startswith("@terms.observation"))
    assert printed.endswith(f"  {file}:{line}\n")
    assert main(["terms", "--terms", str(file), "--kind", "rewards", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["rewards"]["reach_height"]
    assert (found["declared"], found["parameters"]) == ({"weight": 2.0}, [])
    assert main(["terms", "clok", "--terms", str(file)]) == 2
    assert "did you mean 'clock'?" in capsys.readouterr().err
    alone = tmp_path / "alone.py"
    alone.write_text("from polypod import terms\nrewards = {'one': terms.Reward(lambda env: env.base_height, 1.0)}\n")
    assert main(["terms", "--terms", str(alone)]) == 0
    assert "  one [weight=1.0]\n" in capsys.readouterr().out.replace(" " * 29, " ")
    assert main(["terms", "--terms", str(alone), "--kind", "events"]) == 2
    assert "declares no events; leave out --kind" in capsys.readouterr().err
    assert main(["terms", "--kind", "memories"]) == 2
    assert "name a file with --terms" in capsys.readouterr().err
    assert main(["terms", "--terms", str(tmp_path / "absent.py")]) == 2
    assert "cannot read --terms" in capsys.readouterr().err
