"""`sim2sim` judges policies that get up or track motions by that, in both simulators."""

import dataclasses
import json
import shlex

import pytest

import polypod.cli
from polypod import _core
from polypod.evaluation import rising
from polypod.runs import run_dir
from polypod.sim2sim import asked, beginning, on_motions, on_rising, run
from polypod.sim2sim.twin import Physics

TRAIN = ["--num-envs", "8", "--max-iterations", "1", "--logger", "none", "--threads", "1"]
SMALL = ["--set", "train.run.num_steps_per_env=2", "--set", "train.actor.hidden_dims=[16]"]


def trained(folder, config, robots, *words):
    """A run of one iteration."""
    train = [*TRAIN, *SMALL, "--log-dir", str(folder), *words]
    assert polypod.cli.main(["train", "--train-config", config, "--robots", robots, *train]) == 0
    return run_dir.find_checkpoint(folder, "latest")


@pytest.fixture(scope="module")
def gets_up(tmp_path_factory):
    """A policy that does next to nothing, in the task of getting up."""
    return trained(tmp_path_factory.mktemp("getup"), "getup", "anymal_d")


@pytest.fixture(scope="module")
def tracks(tmp_path_factory):
    """The same for motions."""
    return trained(tmp_path_factory.mktemp("tracking"), "tracking", "unitree_g1", "--set", 'motions.clips=["wave"]')


# robots begin in the default pose and hold it
STANDING = ("events.reset_base.roll=[0.0, 0.0]", "events.reset_base.pitch=[0.0, 0.0]")
STANDING += ("events.reset_joints_within_limits_range.enabled=false", "robot_overrides.anymal_d.action_scale=0.001")


def test_who_stands_is_up_in_both(gets_up, tmp_path, capsys):
    words = ["sim2sim", "--checkpoint", str(gets_up), "--num-envs", "3", "--json", str(tmp_path / "up.json")]
    words += [word for change in (*STANDING, "sim.episode_length_s=2.0") for word in ("--set", change)]
    assert polypod.cli.main(words) == 0
    assert "up within 4 s" in capsys.readouterr().out
    found = json.loads((tmp_path / "up.json").read_text())
    for simulator in ("polypod", "mujoco"):
        assert found["robots"]["anymal_d"][simulator]["rate"] == 1.0
    again = shlex.split(found["command"])
    assert again[:2] == ["polypod", "sim2sim"]
    assert again[again.index("--num-envs") + 1] == "3"
    assert "sim.episode_length_s=2.0" in again


def test_who_lies_is_not(gets_up):
    found = on_rising.compare(gets_up, None, beginning.Options(4, steps=100))
    assert found.robots["anymal_d"].mujoco.rate == 0.0
    assert found.robots["anymal_d"].polypod.rate == 0.0
    assert not found.transfers


def test_the_task_says_which_touches_end_an_episode():
    """A base may lie on the ground where a robot gets up, and no thigh where it rears."""
    manifest = {"task": "Getup-Flat-v0", "overrides": [], "canonical_joint_names": []}
    poses = on_rising.Poses(manifest, ["unitree_go1"], beginning.Options(1))
    assert not poses.ends("unitree_go1", None).groups
    rearing = on_rising.Poses({**manifest, "task": "HindLegs-Flat-v0"}, ["unitree_go1"], beginning.Options(1))
    assert {"base", "thigh"} <= rearing.ends("unitree_go1", None).groups


def test_a_robot_transfers_if_it_gets_up_in_nine_of_ten():
    up = rising.Rising(rate=0.9, time_s=1.0, held_s=5.0, least_held_s=5.0)
    assert on_rising.BothRising(polypod=up, mujoco=up).transfers
    assert not on_rising.BothRising(polypod=up, mujoco=dataclasses.replace(up, rate=0.89)).transfers


def test_motions_are_tracked_in_both(tracks, tmp_path, capsys):
    words = ["sim2sim", "--checkpoint", str(tracks), "--num-envs", "2", "--json", str(tmp_path / "both.json")]
    assert polypod.cli.main(words) == 3
    assert capsys.readouterr().out.count("followed") == 2
    found = json.loads((tmp_path / "both.json").read_text())
    assert set(found) == {"polypod", "mujoco"}
    ours, theirs = (found[key]["unitree_g1"]["wave"]["base_m"][0] for key in ("polypod", "mujoco"))
    assert ours == pytest.approx(theirs, rel=0.2)


def test_mujoco_tracks_as_its_flags_say(tracks, monkeypatch):
    """By steps of 2 ms, where none are named."""
    made = []
    monkeypatch.setattr(on_motions, "Twin", lambda robot, bodies, physics, drive: made.append(physics) or 1 / 0)
    for options in (None, beginning.Options(dt=0.004, integrator="RK4", friction=0.5, soft_contact=True)):
        with pytest.raises(ZeroDivisionError):
            on_motions.measure_checkpoint(tracks, options=options, episodes=1, threads=1)
    assert made == [Physics(0.002, friction=0.8), Physics(0.004, "RK4", 0.5, soft_contact=True)]
    with pytest.raises(_core.ConfigError, match=r"dt = 0.003 s does not divide the control step"):
        on_motions.measure_checkpoint(tracks, options=beginning.Options(dt=0.003), episodes=1, threads=1)
    with pytest.raises(_core.ConfigError, match="--friction -1"):
        on_motions.measure_checkpoint(tracks, options=beginning.Options(friction=-1.0), episodes=1, threads=1)


def test_flags_of_velocities_are_refused(gets_up, tracks, capsys):
    assert polypod.cli.main(["sim2sim", "--checkpoint", str(gets_up), "--command", "1", "0", "0"]) == 2
    assert "--command: the policy follows no velocity command" in capsys.readouterr().err
    assert polypod.cli.main(["sim2sim", "--checkpoint", str(tracks), "--steps", "5"]) == 2
    assert "--steps: the policy tracks motions" in capsys.readouterr().err


def test_what_is_asked_is_the_task_s(gets_up, tracks):
    assert asked.of(gets_up, None, ()) == "rising"
    assert asked.of(tracks, None, ()) == "motions"
    one_of_two = run_dir.read_manifest(gets_up) | {"task": "Velocity-Flat-HeteroQuadruped-v0"}
    with pytest.raises(_core.ConfigError, match="not rewarded for `upright`"):
        on_rising.Poses(one_of_two, ["anymal_d"], beginning.Options(1))
    with pytest.raises(_core.ConfigError, match="velocity commands"):
        run.Episode(run_dir.read_manifest(gets_up), ["anymal_d"], beginning.Options(1))
