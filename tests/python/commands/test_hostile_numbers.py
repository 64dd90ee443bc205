"""Every number of every config: a hostile value is refused by its key in one line, or does no harm.

The numbers are those of the resolved configs, so that a new key is tested as soon as it is there.
"""

import random

import numpy as np
import pytest

import polypod
from common import SMALL_TERRAIN, size
from polypod.compat import tomllib
from polypod.runs import config

HOSTILE = ("1e308", "-1e308", "1e39", "1e-320", "-1", "0", "nan", "inf")
TASKS = {
    "velocity_flat": (["unitree_a1", "spot"], ()),
    "velocity_flat_universal": (["unitree_go2"], ()),
    "velocity_flat_humanoid": (["unitree_h1"], ()),
    "velocity_rough": (["unitree_a1"], SMALL_TERRAIN),
    "velocity_obstacles": (["unitree_a1"], ()),
}
STEPS = 50
SHARE = size(0.01, 1.0)
"""Share of all pairs of a key and a value that is tried."""


def numbers(value, path=()):
    """Paths of all numbers of a config, as overrides name them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from numbers(inner, (*path, key))
    elif isinstance(value, list):
        for place, inner in enumerate(value):
            yield from numbers(inner, (*path, str(place)))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


def with_events(task, overrides):
    """The overrides with all events of the task on: numbers of disabled ones are not read."""
    events = tomllib.loads(polypod.make(task, overrides=overrides).sim.resolved_config())["task"]["events"]
    return [*overrides, *(f"events.{name}.enabled=true" for name in events)]


def sample(pairs, seed):
    chosen = random.Random(seed).sample(pairs, max(1, round(SHARE * len(pairs))))
    return sorted(chosen)


def check_refusal(error, path, text):
    message = str(error)
    assert "\n" not in message, text
    assert len(message) < 600, text
    # two numbers that contradict each other are named by their table
    keys = [part for part in path if not part.isdigit()][-2:]
    assert any(key in message for key in keys), f"{text}: {message}"
    assert "None" not in message, f"{text}: {message}"
    assert not any(len(word) > 60 and word.strip("`-.,;").isdigit() for word in message.split()), message


@pytest.mark.parametrize("task", TASKS)
def test_numbers_of_tasks_and_robots(task):
    robots, few = TASKS[task]
    few = with_events(task, few)
    whole = tomllib.loads(polypod.make(task, robots=robots, overrides=few).sim.resolved_config())
    paths = [path for path in numbers(whole["task"]) if path[0] != "robot_overrides"]
    for robot, said in whole["robots"].items():
        paths += [("robot_overrides", robot, *path) for path in numbers(said)]
    harm = []
    for path, value in sample([(path, value) for path in paths for value in HOSTILE], task):
        text = f"{'.'.join(path)}={value}"
        try:
            env = polypod.make(task, 4 * len(robots), robots=robots, seed=1, threads=1, overrides=[*few, text])
        except polypod.ConfigError as error:
            check_refusal(error, path, text)
            continue
        rng = np.random.default_rng(0)
        observation, _ = env.reset()
        finite, ends = np.isfinite(observation).all(), 0
        for _ in range(STEPS):
            actions = rng.uniform(-0.1, 0.1, env.action_space.shape).astype(np.float32)
            observation, reward, terminated, truncated, _ = env.step(actions)
            finite = finite and np.isfinite(observation).all() and np.isfinite(reward).all()
            ends += (terminated | truncated).all()
        if not finite or ends == STEPS:
            harm.append(f"{text}: finite {finite}, all envs end in {ends} of {STEPS} steps")
    assert not harm, "\n".join(harm)


@pytest.mark.parametrize("name", ["flat", "legged_finish", "flat_joints"])
def test_numbers_of_trainings(name):
    whole = config.load(name).as_dict()
    pairs = [(path, value) for path in numbers(whole) for value in HOSTILE]
    for path, value in pairs:
        text = f"{'.'.join(path)}={value}"
        try:
            changed = config.load(name, [text])
        except polypod.ConfigError as error:
            check_refusal(error, path, text)
            continue
        assert value in ("-1", "0", "1e-320"), text
        found = changed.as_dict()
        for key in path:
            found = found[int(key) if key.isdigit() else key]
        assert found == float(value)


def test_a_long_number_is_shown_short():
    for text in ("sim.decimation=1e308", "sim.dt=1e308", "sim.gravity=[0,0,1e300]", "sim.episode_length_s=-1e308"):
        with pytest.raises(polypod.ConfigError) as caught:
            polypod.make("velocity_flat", overrides=[text])
        assert "e30" in str(caught.value)
        assert len(str(caught.value)) < 300


def test_a_training_refuses_a_pose_in_one_line(cli):
    done = cli("train", "--logger", "none", "--set", "robot_overrides.spot.default_pose.RH_HFE=1e308")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "default_pose.RH_HFE" in done.stderr
