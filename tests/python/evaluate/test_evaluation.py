"""An evaluation counts every env once, and its figures are those of the simulation."""

import dataclasses
import json
import math
import shlex
import sys

import numpy as np
import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY, SHORT, SMALL_TERRAIN, TASK, size
from polypod import evaluation
from polypod.evaluation import measures, plot, seeds, walking
from polypod.evaluation.results import robot_result
from polypod.runs import run_dir
from polypod.training import report


def still(observations):
    return np.zeros((len(observations), 12), dtype=np.float32)


def test_the_play_variant_is_used():
    assert evaluation.play_task(TASK) == "Velocity-Flat-HeteroQuadruped-Play-v0"
    assert evaluation.play_task("velocity_flat") == "Velocity-Flat-HeteroQuadruped-Play-v0"
    assert evaluation.play_task("Velocity-Flat-HeteroQuadruped-Play-v0") == "Velocity-Flat-HeteroQuadruped-Play-v0"


def test_every_env_counts_once():
    found = evaluation.evaluate(still, TASK, num_envs=20, overrides=SHORT, episodes=2)
    assert sum(result.episodes for result in found.robots.values()) == 40
    assert found.duration_s == pytest.approx(0.4)
    for result in found.robots.values():
        assert 0.0 <= result.fall_rate <= 1.0
        assert 0.0 < result.episode_length_s <= 0.4 + 1e-9


def test_figures_are_those_of_the_simulation():
    """Recomputed from a copy of the same episodes, env by env."""
    robots = ["spot", "unitree_a1"]
    found = evaluation.evaluate(still, TASK, robots=robots, num_envs=8, overrides=SHORT, seed=4, commands="task")
    env = polypod.make(found.task, num_envs=8, robots=robots, seed=4, overrides=SHORT, autoreset="disabled")
    env.reset(seed=4)
    columns = {"base_lin_vel": 0, "base_ang_vel": 3, "velocity_commands": 9}
    start = 0
    for term, width in env.observation_layout:
        columns[term], start = start, start + width
    velocity, turn, command = (columns[name] for name in ("base_lin_vel", "base_ang_vel", "velocity_commands"))
    errors, rewards, joints, feet = [[] for _ in range(8)], [0.0] * 8, [[] for _ in range(8)], [[] for _ in range(8)]
    running, fallen = set(range(8)), set()
    while running:
        observations, reward, terminated, truncated, _ = env.step(still(env.sim.observation))
        for row in sorted(running):
            wanted = observations[row, command : command + 3]
            planar = np.hypot(*(wanted[:2] - observations[row, velocity : velocity + 2]))
            errors[row].append((planar, abs(wanted[2] - observations[row, turn + 2])))
            rewards[row] += reward[row]
            power = sum(abs(e * v) for e, v in zip(env.state.joint_effort[row], env.state.joint_vel[row], strict=True))
            joints[row].append((power, np.hypot(*env.state.base_lin_vel[row, :2])))
            for foot in range(4):
                axes = slice(3 * foot, 3 * foot + 3)
                if np.linalg.norm(env.state.contact_forces[row, axes]) > 1.0:
                    feet[row].append(np.hypot(*env.state.feet_vel[row, axes][:2]))
            if terminated[row]:
                fallen.add(row)
        running -= set(np.flatnonzero(terminated | truncated).tolist())
        done = terminated | truncated
        if done.any():
            env.reset(options={"reset_mask": done})
    for robot in robots:
        rows = env.env_ids(robot)
        planar, yaw = np.mean([np.mean(errors[row], axis=0) for row in rows], axis=0)
        seconds = sum(len(errors[row]) for row in rows) * env.step_dt
        assert found.robots[robot].error_vel_xy == pytest.approx(planar, rel=1e-5)
        assert found.robots[robot].error_vel_yaw == pytest.approx(yaw, rel=1e-5)
        assert found.robots[robot].reward_per_s == pytest.approx(sum(rewards[row] for row in rows) / seconds, rel=1e-4)
        assert found.robots[robot].fall_rate == len(fallen & set(rows.tolist())) / len(rows)
        assert found.robots[robot].power == pytest.approx(np.mean([np.mean(joints[row], axis=0)[0] for row in rows]))
        energy, distance = env.step_dt * np.sum([np.sum(joints[row], axis=0) for row in rows], axis=0)
        weight = 9.81 * json.loads(env.sim.robot_info())[robot]["mass"]
        assert found.robots[robot].cost_of_transport == pytest.approx(energy / (weight * distance))
        assert found.robots[robot].foot_slip == pytest.approx(np.mean([slip for row in rows for slip in feet[row]]))
    env.close()


@pytest.mark.parametrize(("name", "value"), [("num_envs", 0), ("episodes", 0), ("steps", 0), ("grid", (3, 0, 3))])
def test_counts_are_positive(name, value):
    with pytest.raises(polypod.ConfigError, match=name):
        evaluation.evaluate(still, TASK, **{name: value})


def test_rough_ground_is_told_by_type_and_level():
    """Robots that hold their pose stay up on every platform and follow nothing."""
    arguments = {"robots": ["unitree_a1"], "num_envs": 40, "steps": 100, "seed": 1, "commands": "task"}
    found = evaluation.evaluate(still, "velocity_rough", **arguments)
    (result,) = found.robots.values()
    assert set(result.terrain) == {
        *("pyramid_stairs", "pyramid_stairs_inv", "boxes", "random_rough", "hf_pyramid_slope", "hf_pyramid_slope_inv")
    }
    tiles = [tile for tiles in result.terrain.values() for tile in tiles]
    assert sum(tile.episodes for tile in tiles) == 40
    assert all(0 <= tile.level < 5 and tile.fall_rate == 0.0 for tile in tiles)
    assert [tile.level for tile in result.terrain["boxes"]] == sorted(tile.level for tile in result.terrain["boxes"])
    # only those that were told to go slower than 0.2 m/s or to stand have done as they were told
    assert result.success() < 0.3
    assert result.success("boxes") == pytest.approx(
        np.average([t.success for t in result.terrain["boxes"]], weights=[t.episodes for t in result.terrain["boxes"]])
    )
    assert np.isnan(result.success("boxes", level=7))


def test_a_plane_has_no_tiles():
    (result,) = evaluation.evaluate(still, TASK, robots=["spot"], num_envs=2, overrides=SHORT).robots.values()
    assert result.terrain == {}


def test_power_is_that_of_every_joint_driving_or_braking():
    effort = np.array([[10.0, -2.0, 3.0], [0.0, 5.0, -1.0]])
    velocity = np.array([[1.5, 4.0, 0.0], [7.0, 2.0, -3.0]])
    np.testing.assert_allclose(measures.joint_power(effort, velocity), [15.0 + 8.0, 10.0 + 3.0])


def test_only_feet_on_the_ground_slip():
    """One robot slides on a foot at 0.5 m/s and lifts the other.

    One stands on both, of which one slides at 0.1 m/s.
    """
    forces = np.array([[0.0, 3.0, 4.0, 0.0, 0.0, 0.9], [0.0, 0.0, 50.0, 0.0, 0.0, 60.0]])
    velocities = np.array([[0.3, -0.4, 9.0, 2.0, 2.0, 2.0], [0.0, 0.0, 0.0, 0.06, 0.08, 0.0]])
    slip, contact = measures.foot_slip(forces, velocities)
    np.testing.assert_allclose(slip, [0.5, 0.1])
    np.testing.assert_array_equal(contact, [1.0, 2.0])


def test_a_foot_stumbles_on_a_wall_and_not_on_a_slope():
    """Sideways forces of 5 and 3 times the vertical one, of less than 1 N, and of none."""
    forces = [[30.0, 40.0, -10.0, 30.0, 0.0, 10.0], [0.9, 0.0, 0.0, 0.0, 0.0, 200.0], [5.0, 0.0, 0.0, 0.0, 8.0, 1.0]]
    np.testing.assert_array_equal(measures.stumbles(forces), [1.0, 0.0, 2.0])


def test_what_feet_do_on_tiles_by_hand():
    """Two envs on slopes of two levels: figures by tile, by type, and in the file."""
    sums = sums_of(power=[1e4, 3e4], slip=[0.3, 0.5], contact=[3.0, 1.0], stumbles=[0.0, 1.0], level=[0.0, 4.0])
    result = robot_result(sums, 100, 0.02, 200.0, ["slope", "slope"])
    easy, hard = result.terrain["slope"]
    assert (easy.level, easy.power, easy.stumbles) == (0, 100.0, 0.0)
    assert (hard.level, hard.power, hard.stumbles) == (4, 300.0, 1.0)
    assert (easy.foot_slip, hard.foot_slip) == (pytest.approx(0.1), 0.5)
    assert result.stumbles == 0.25
    assert result.on_tiles("power", "slope") == 200.0
    assert result.on_tiles("power", level=4) == 300.0
    assert math.isnan(result.on_tiles("power", "stairs"))


def test_tracking_is_the_references():
    """Perfect; half a metre per second off.

    A quarter of a radian per second off: exp(-1), exp(-1/4).
    """
    found = measures.tracking([0.0, 0.5, 0.0], [0.0, 0.0, 0.25])
    np.testing.assert_allclose(found, [1.0, (math.exp(-1.0) + 0.5) / 1.5, (1.0 + 0.5 * math.exp(-0.25)) / 1.5])


def test_a_fall_ends_the_tracking_reward():
    """50 of 100 steps at 0.8, then a fall; and the whole episode at 0.6."""
    sums = sums_of(steps=[50.0, 100.0], tracking=[40.0, 60.0], fell=[1.0, 0.0])
    assert robot_result(sums, 100, 0.02, 1.0, []).tracking_reward == pytest.approx(0.5)


def sums_of(**values):
    """Sums over one episode each of two envs, 100 steps long."""
    zeros = np.zeros((1, 2))
    keys = (
        "reward",
        "fell",
        "xy",
        "yaw",
        "still_xy",
        "still_yaw",
        "tracking",
        "power",
        "speed",
        "slip",
        "contact",
        "stumbles",
        "level",
    )
    given = {key: np.array([value]) for key, value in values.items()}
    return {"steps": zeros + 100.0, **dict.fromkeys(keys, zeros), **given}


def test_figures_of_two_episodes_by_hand():
    """800 J over 4 m; 3 contacts of 0.1 m/s and one of 0.5 m/s.

    2 s at 100 W and 0.5 m/s, 2 s at 300 W and 1.5 m/s.
    """
    sums = sums_of(power=[1e4, 3e4], speed=[50.0, 150.0], slip=[0.3, 0.5], contact=[3.0, 1.0], fell=[0.0, 1.0])
    result = robot_result(sums, 100, 0.02, 200.0, [])
    assert result.power == pytest.approx(200.0)
    assert result.cost_of_transport == pytest.approx(800.0 / (200.0 * 4.0))
    assert result.foot_slip == pytest.approx(0.2)
    assert result.fall_rate == result.success_rate == 0.5
    still = robot_result(sums_of(), 100, 0.02, 200.0, [])
    assert math.isnan(still.cost_of_transport)
    assert math.isnan(still.foot_slip)


def test_success_is_to_follow_and_not_to_fall():
    """Allowed are half of a standing robot's error, or 0.2 m/s."""
    steps = 100.0
    for error, still, fell, succeeds in (
        (0.49, 1.0, 0.0, True),
        (0.51, 1.0, 0.0, False),
        (0.19, 0.1, 0.0, True),
        (0.21, 0.1, 0.0, False),
        (0.00, 1.0, 1.0, False),
    ):
        sums = sums_of(xy=[error * steps] * 2, still_xy=[still * steps] * 2, fell=[fell] * 2)
        assert robot_result(sums, 100, 0.02, 1.0, []).success_rate == float(succeeds)


def test_every_command_of_the_grid_is_held_and_equally_often():
    seen = []

    def watch(observations):
        seen.append(observations[:, 9:12].copy())
        return still(observations)

    arguments = {"robots": ["unitree_a1", "spot"], "num_envs": 20, "episodes": 3, "overrides": SHORT, "grid": (3, 1, 5)}
    found = evaluation.evaluate(watch, TASK, **arguments)
    assert found.grid == (3, 1, 5)
    for result in found.robots.values():
        assert {entry.command for entry in result.commands} == {
            (x, 0.0, w) for x in (-1.0, 0.0, 1.0) for w in (-1.0, -0.5, 0.0, 0.5, 1.0)
        }
        assert {entry.episodes for entry in result.commands} == {2}
        assert result.still_error_vel_xy == pytest.approx(2 / 3)
        assert result.still_error_vel_yaw == pytest.approx(0.6)
        assert sum(entry.error_vel_xy for entry in result.commands) / 15 == pytest.approx(result.error_vel_xy)
    for episode in range(3):
        steps = seen[20 * episode : 20 * (episode + 1)]
        assert all((step == steps[0]).all() for step in steps)
    # the second episode goes on where the first one ended
    assert not (seen[0] == seen[20]).all()


def test_randomized_means_as_in_the_training():
    """Observations are noisy and bodies differ; without it neither."""

    def standing_noise(**options):
        seen = []

        def watch(observations):
            seen.append(observations.copy())
            return still(observations)

        evaluation.evaluate(watch, "velocity_flat_universal", robots=["unitree_go2"], num_envs=8, steps=3, **options)
        # noise of the joint velocities at the first step, where robots are at rest; masses
        return np.abs(seen[0][:, 24:36]).max(), np.ptp(seen[0][:, 48])

    assert standing_noise() == (0.0, 0.0)
    noise, masses = standing_noise(randomized=True)
    assert 1.0 < noise < 1.5
    assert masses > 0.0
    found = evaluation.evaluate(still, TASK, robots=["spot"], num_envs=2, overrides=SHORT, randomized=True)
    assert found.randomized
    assert found.task == evaluation.play_task(TASK)


OWN = """
extends = "velocity_flat_universal"
name = "{name}"
experiment_name = "own"
"""


@pytest.fixture
def own_tasks(tmp_path, monkeypatch):
    """Custom tasks without a Play variant, by name, and from outside any library, by path."""
    folder = tmp_path / "library" / "configs" / "tasks"
    folder.mkdir(parents=True)
    (folder / "own.toml").write_text(OWN.format(name="Own-HeteroQuadruped-v0"))
    (tmp_path / "elsewhere.toml").write_text(OWN.format(name="Elsewhere-v0"))
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "library"))
    return ["own", "Own-HeteroQuadruped-v0", "Own-Spot-v0", str(tmp_path / "elsewhere.toml")]


def test_tasks_without_a_play_variant_are_measured_without_noise_and_pushes(own_tasks):
    """They have the figures of the task with all of it switched off, and say what was on."""
    arguments = {"robots": ["spot"], "num_envs": 4, "steps": 25}
    expected = evaluation.evaluate(still, "velocity_flat_universal", **arguments)
    disturbed = evaluation.evaluate(still, "velocity_flat_universal", randomized=True, **arguments)
    assert (expected.randomized, expected.disturbances) == (False, [])
    assert {"observations.enable_noise", "events.push_robot.enabled"} < set(disturbed.disturbances)
    for task in own_tasks:
        found = evaluation.evaluate(still, task, **arguments)
        assert (found.randomized, found.disturbances) == (False, [])
        assert "-Play-v0" in found.task
        assert found.robots == expected.robots
        again = evaluation.evaluate(still, task, randomized=True, **arguments)
        assert again.randomized
        assert again.disturbances == disturbed.disturbances
        assert again.robots == disturbed.robots
    assert expected.robots != disturbed.robots


def test_what_a_training_changed_is_on_with_randomized_alone():
    """An event that a training has switched on would otherwise be on in every evaluation."""
    push = "events.push_robot={ enabled = true, interval_range_s = [0.1, 0.1], velocity_range = [-1.0, 1.0] }"
    arguments = {"robots": ["spot"], "num_envs": 4, "steps": 25}
    quiet = evaluation.evaluate(still, TASK, **arguments)
    found = evaluation.evaluate(still, TASK, trained=[push, "observations.enable_noise=true"], **arguments)
    assert (found.randomized, found.robots) == (False, quiet.robots)
    pushed = evaluation.evaluate(still, TASK, trained=[push], randomized=True, **arguments)
    assert pushed.robots["spot"].error_vel_xy > quiet.robots["spot"].error_vel_xy
    # a change in the evaluation itself is made, and reported
    asked = evaluation.evaluate(still, TASK, overrides=[push], **arguments)
    assert (asked.randomized, asked.disturbances) == (True, ["events.push_robot.enabled"])
    assert report._conditions(asked).endswith("0.5 s, with pushes, a new command every 5 s")
    assert report._conditions(quiet).endswith("0.5 s, a new command every 5 s")


def test_the_commands_of_walking_are_given_and_judged():
    """The policy sees the schedule in each control step.

    The figures of walking are those of the evaluation.
    """
    seen = []

    def watch(observations):
        seen.append(observations[:, 9:12].copy())
        return still(observations)

    found = evaluation.evaluate(watch, TASK, robots=["spot", "unitree_a1"], num_envs=6, seed=3, episodes=2)
    assert (found.commands, found.duration_s, found.grid) == ("walking", 20.0, None)
    told = np.array(seen)
    assert told.shape == (2000, 6, 3)
    box = {"lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-1.0, 1.0), "ang_vel_z": (-1.0, 1.0)}
    for episode, steps in enumerate(np.split(told, 2)):
        schedule = walking.Schedule.draw(box, 3, 1000, 0.02, 3 + episode)
        for robot in (slice(0, 3), slice(3, 6)):
            # an observation has the command of the step before it, as when the task draws a new one
            wanted = np.repeat(schedule.commands, 250, axis=0)
            np.testing.assert_array_equal(steps[1:, robot], wanted[:-1])
            np.testing.assert_array_equal(steps[0, robot], wanted[0])
    for result in found.robots.values():
        figures = result.walking
        for key in ("error_vel_xy", "still_error_vel_xy", "error_vel_yaw", "still_error_vel_yaw", "fall_rate"):
            assert getattr(figures, key) == pytest.approx(getattr(result, key), rel=1e-6), key
        assert (figures.episodes, figures.kinds) == (6, walking.KINDS)
        assert {"share of still", "yaw error", "turn"} <= set(walking.faults(figures))
        assert not evaluation.walks(figures)
    assert found.robots["spot"].walking.drift_xy < 0.01


def test_a_robot_is_judged_as_it_is_alone_on_any_number_of_threads():
    arguments = {"num_envs": 4, "seed": 5}
    (alone,) = evaluation.evaluate(still, TASK, robots=["spot"], threads=1, **arguments).robots.values()
    many = evaluation.evaluate(still, TASK, robots=["unitree_a1", "spot"], num_envs=8, seed=5, threads=2)
    assert many.robots["spot"] == alone


def test_commands_of_the_task_are_not_judged():
    found = evaluation.evaluate(still, TASK, robots=["spot"], num_envs=2, steps=5, commands="task")
    assert found.commands == "task"
    assert found.robots["spot"].walking is None
    assert report._conditions(found).endswith("commands of the task")
    with pytest.raises(polypod.ConfigError, match="commands = 'talking'; use one of walking, task"):
        evaluation.evaluate(still, TASK, robots=["spot"], num_envs=2, steps=5, commands="talking")


def test_pushes_come_with_randomized_unless_switched_off():
    """Standing robots are faster when they are pushed sideways every half second."""
    pushes = ["events.push_robot.interval_range_s=[0.3, 0.5]", "events.push_robot.velocity_range=[-1.0, 1.0]"]
    speeds = []
    for changes in (pushes, [*pushes, "events.push_robot.enabled=false"]):
        arguments = {"robots": ["unitree_b2"], "num_envs": 8, "steps": 100, "grid": (1, 1, 1), "randomized": True}
        (result,) = evaluation.evaluate(still, TASK, overrides=changes, **arguments).robots.values()
        speeds.append(result.error_vel_xy)
    assert speeds[0] > 2.0 * speeds[1]


def test_an_evaluation_survives_its_file():
    found = evaluation.evaluate(still, TASK, robots=["spot"], num_envs=4, steps=5, grid=(2, 2, 1))
    again = evaluation.Evaluation.from_dict(json.loads(json.dumps(found.as_dict(), allow_nan=False)))
    assert again == found
    arguments = {"num_envs": 10, "steps": 5, "overrides": SMALL_TERRAIN}
    rough = evaluation.evaluate(still, "velocity_rough", robots=["spot"], **arguments)
    assert rough.robots["spot"].terrain
    assert rough.robots["spot"].walking.turn_reached != rough.robots["spot"].walking.turn_reached
    assert evaluation.Evaluation.from_dict(json.loads(json.dumps(rough.as_dict(), allow_nan=False))) == rough
    # a file of a build that knew no walking
    old = found.as_dict()
    del old["commands"], old["robots"]["spot"]["walking"]
    assert evaluation.Evaluation.from_dict(old) == found
    older = {**old, "grid": None}
    assert evaluation.Evaluation.from_dict(older).commands == "task"


def test_quantiles_are_those_of_the_tables():
    """Student's t, 97.5 %, as in Abramowitz and Stegun 26.10 (two-sided 0.95)."""
    for degrees, quantile in ((1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (9, 2.262), (30, 2.042)):
        assert seeds.t_quantile(0.975, degrees) == pytest.approx(quantile, abs=6e-4)


def test_an_interval_by_hand():
    """1, 2, 3: mean 2, deviation 1, so 4.3027 / sqrt(3) to either side."""
    found = seeds.interval([1.0, 2.0, 3.0])
    assert (found.mean, found.seeds) == (2.0, 3)
    assert found.high - found.mean == pytest.approx(4.302653 / math.sqrt(3), rel=1e-5)
    assert found.mean - found.low == pytest.approx(found.high - found.mean)
    alone = seeds.interval([4.0])
    assert alone.mean == 4.0
    assert math.isnan(alone.low)


def test_intervals_hold_the_mean_as_often_as_they_say():
    random = np.random.default_rng(0)
    draws = random.normal(3.0, 2.0, size=(size(4000, 40_000), 3))
    held = [found.low <= 3.0 <= found.high for found in map(seeds.interval, draws)]
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)


def test_a_summary_is_the_mean_over_the_policies():
    def evaluate(scale):
        def policy(observations):
            return np.full((len(observations), 12), scale, dtype=np.float32)

        return evaluation.evaluate(policy, TASK, robots=["spot"], num_envs=4, steps=20)

    evaluations = [evaluate(scale) for scale in (0.0, 0.5, 1.0)]
    summary = evaluation.summarize(evaluations)
    errors = [each.robots["spot"].error_vel_xy for each in evaluations]
    assert len(set(errors)) == 3
    assert summary.robots["spot"]["error_vel_xy"] == seeds.interval(errors)
    content = summary.as_dict()
    assert "Student" in content["interval"]
    assert len(content["evaluations"]) == 3
    other = evaluation.evaluate(still, TASK, robots=["unitree_a1"], num_envs=4, steps=20)
    with pytest.raises(polypod.ConfigError, match="differ in robots"):
        evaluation.summarize([evaluations[0], other])
    with pytest.raises(polypod.ConfigError, match="no evaluation"):
        evaluation.summarize([])


def test_threads_leave_every_bit():
    arguments = {"num_envs": 24, "steps": 30, "grid": (2, 2, 1), "randomized": True, "seed": 3}
    assert evaluation.evaluate(still, TASK, threads=1, **arguments) == evaluation.evaluate(
        still, TASK, threads=2, **arguments
    )


CHECKPOINT = str(FLAT_POLICY)
QUICK = ("--robots", "spot,unitree_go2", "--num-envs", "8", "--steps", "10")


def test_the_command_line_writes_figures_and_a_picture(tmp_path, capsys):
    out, drawn = tmp_path / "one.json", tmp_path / "one.png"
    arguments = ["eval", "--checkpoint", CHECKPOINT, *QUICK, "--grid", "2", "2", "1", "--randomized"]
    assert polypod.cli.main([*arguments, "--json", str(out), "--plot", str(drawn)]) == 0
    shown = capsys.readouterr().out
    assert "randomised and pushed, 2x2x1 commands" in shown
    assert "CoT" in shown
    found = evaluation.Evaluation.from_dict(json.loads(out.read_text()))
    assert found.randomized
    assert found.checkpoint["seed"] == run_dir.read_manifest(FLAT_POLICY)["seed"]
    assert found.checkpoint["iteration"] == int(FLAT_POLICY.stem.removeprefix("model_"))
    assert len(found.robots["spot"].commands) == 4
    # its own command line measures the same again
    again = shlex.split(evaluation.command(found))[1:]
    assert polypod.cli.main([*again, "--json", str(out)]) == 0
    assert evaluation.Evaluation.from_dict(json.loads(out.read_text())) == found
    assert drawn.read_bytes().startswith(b"\x89PNG")


def test_several_checkpoints_are_summarised(tmp_path, capsys):
    out = tmp_path / "both.json"
    code = polypod.cli.main(["eval", "--checkpoint", CHECKPOINT, CHECKPOINT, *QUICK, "--json", str(out)])
    assert code == 0
    assert "2 policies" in capsys.readouterr().out
    content = json.loads(out.read_text())
    interval = content["robots"]["spot"]["error_vel_xy"]
    assert interval["low"] == interval["mean"] == interval["high"]
    assert len(content["evaluations"]) == interval["seeds"] == 2


def test_the_picture_shows_tiles_and_seeds(tmp_path):
    arguments = {"num_envs": 20, "steps": 5, "overrides": SMALL_TERRAIN}
    rough = evaluation.evaluate(still, "velocity_rough", robots=["spot", "anymal_d"], **arguments)
    summary = evaluation.summarize([rough, dataclasses.replace(rough, seed=1)])
    for name in ("tiles.png", "tiles.svg"):
        plot.picture(summary, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 10_000
    with pytest.raises(polypod.ConfigError, match="cannot write"):
        plot.picture(summary, tmp_path / "tiles.unknown")


def test_the_package_for_pictures_is_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert polypod.cli.main(["eval", "--checkpoint", CHECKPOINT, *QUICK, "--plot", str(tmp_path / "x.png")]) == 2
    assert "pip install 'polypod[bench]'" in capsys.readouterr().err
