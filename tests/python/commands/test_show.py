"""`polypod show`: each value of a config is that of the file that it names."""

import json
import math

import pytest

from polypod import _core, origins
from polypod.cli import main
from polypod.compat import tomllib
from polypod.runs import config

TASKS = sorted({entry["file"]: entry["name"] for entry in _core.tasks()}.values())
"""One task of each file: some are made for one robot."""
ROBOTS = sorted(entry["name"] for entry in _core.robots())
TRAIN = sorted(entry["name"] for entry in _core.train_configs())


def same(one, other):
    if isinstance(one, float) or isinstance(other, float):
        numbers = isinstance(one, int | float) and isinstance(other, int | float)
        return numbers and (one == other or math.isclose(one, other, rel_tol=1e-6))
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def at(table, key):
    """A value in a file, by its dotted key."""
    node = table
    for word in key.split("."):
        if isinstance(node, list):
            named = [e for e in node if isinstance(e, dict) and word in (e.get("name"), e.get("term"))]
            node = named[0] if named else node[int(word)]
        else:
            node = node[word]
    return node


def check(layers, resolved, found):
    """Values are those of their files; a default is in no file above the list that it is in."""
    files = dict(layers)
    assert len(files) == len(layers)
    for value in found:
        if value.origin == origins.DEFAULT:
            continue
        assert same(at(files[value.origin], value.key), value.value), value
        # no file above says anything else
        above = [name for name, _ in layers][[name for name, _ in layers].index(value.origin) + 1 :]
        for name in above:
            try:
                at(files[name], value.key)
            except (KeyError, ValueError, IndexError, TypeError):
                continue
            raise AssertionError(f"{value} is also in {name}")
    assert {value.origin for value in found} > {layers[-1][0]}
    kept = {value.key for value in found}
    assert len(kept) == len(found)
    assert resolved


@pytest.mark.parametrize("name", TASKS)
def test_tasks(name):
    texts, resolved = _core.explain_task(name)
    layers = [(file, tomllib.loads(text)) for file, text in texts]
    check(layers, resolved, origins.values(layers, tomllib.loads(resolved)))


@pytest.mark.parametrize("name", ROBOTS)
def test_robots(name):
    texts, resolved = _core.explain_robot(name)
    layers = [(file, tomllib.loads(text)) for file, text in texts]
    check(layers, resolved, origins.values(layers, tomllib.loads(resolved)))


@pytest.mark.parametrize("name", TRAIN)
def test_train_configs(name):
    layers = config.layers(name)
    resolved = config.load(name).as_dict()
    check(layers, resolved, origins.values(layers, resolved))


def shown(capsys, *line):
    assert main(["show", *line, "--json"]) == 0
    return {value["key"]: value for value in json.loads(capsys.readouterr().out)}


def test_files_overrides_and_defaults_are_told_apart(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "velocity_flat_universal"\nname = "Mine-v0"\n[sim]\ndt = 0.004\n')
    found = shown(capsys, str(path), "--set", "sim.decimation=5", "--set", "observations.policy.base_lin_vel.noise=0.3")
    assert (found["sim.dt"]["value"], found["sim.dt"]["origin"]) == (0.004, str(path))
    assert (found["sim.decimation"]["value"], found["sim.decimation"]["origin"]) == (5, "--set")
    assert found["observations.policy.base_lin_vel.noise"]["origin"] == "--set"
    assert found["observations.policy.base_ang_vel.noise"]["origin"].endswith("velocity_flat_universal.toml")
    assert found["sim.episode_length_s"]["origin"].endswith("velocity_flat.toml")
    assert found["experiment_name"]["origin"].endswith("velocity_flat_universal.toml")
    assert found["commands.base_velocity.rel_sideways_envs"]["origin"] == "default"


def test_the_command_finds_the_kind(capsys):
    assert main(["show", "spot", "--only", "name"]) == 0
    assert capsys.readouterr().out.startswith("robot spot\n")
    assert main(["show", "quick", "--only", "run.num_envs", "--set", "train.run.num_envs=64"]) == 0
    assert capsys.readouterr().out == "train quick\nrun.num_envs = 64  # --set\n"
    assert main(["show", "velocity_flat_play", "--only", "observations.enable_noise"]) == 0
    assert "velocity_flat_play.toml" in capsys.readouterr().out
    # made by the library
    assert main(["show", "Getup-Flat-Play-v0", "--only", "observations.enable_noise"]) == 0
    assert "made by the library" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["velocity_flatt"], "velocity_flat"),
        (["spot", "--set", "action_scale=1"], "robot_overrides.spot"),
        (["velocity_flat", "--only", "sim.nothing"], "no such key"),
        (["velocity_flat", "--set", "sim.nothing=1"], "nothing"),
        (["velocity_flat", "--kind", "robot"], "velocity_flat"),
    ],
)
def test_what_cannot_be_shown_is_one_line(line, said, capsys):
    assert main(["show", *line]) == 2
    errors = capsys.readouterr().err
    assert said in errors
    assert errors.count("\n") == 1
