"""The exported policy walks in MuJoCo as in polypod, through MuJoCo's own sensors."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import polypod
import polypod.cli
from common import FLAT_POLICY, LEGGED_POLICY, ROUGH_POLICY, SMALL_TERRAIN, size
from polypod import sim2sim
from polypod.evaluation import load_network, walking
from polypod.export import OnnxPolicy, interfaces, onnx_graph
from polypod.export.torch_graph import RobotPolicy
from polypod.mujoco_model import robot as model_robot
from polypod.policy import load
from polypod.runs import run_dir
from polypod.sim2sim import beginning, commands, run, twin

TASK = "Velocity-Flat-Universal-Play-v0"
CLOSE = 0.1
"""Largest difference of the velocity errors in the two simulators, m/s."""
SLIDES = 0.03
"""Difference from which a small robot slides, m/s."""


def make_twin(robot, num_envs=4, delay=0, checkpoint=FLAT_POLICY, task=TASK, overrides=(), physics=None):
    manifest, state = run_dir.read_manifest(checkpoint), run_dir.load_checkpoint(checkpoint)
    manifest = {**manifest, "overrides": [*manifest["overrides"], *overrides]}
    network = load_network(state, manifest["policy"])
    interface = interfaces(manifest, [robot])[robot]
    policy = OnnxPolicy(onnx_graph.robot_model(network, interface, {}).SerializeToString())
    sim = polypod.VecSim(
        task, num_envs, robots=[robot], seed=5, threads=1, autoreset="disabled", overrides=list(overrides)
    )
    described = model_robot.of(sim, robot, robot)
    bodies = [body["name"] for body in json.loads(sim.robot_shapes())[robot]["bodies"] if body["group"] == "base"]
    drive = twin.Drive(
        interface,
        policy,
        step_dt=0.02,
        physics_dt=0.005,
        delays=np.full((num_envs, 12), float(delay)),
        heights=sim2sim.heights(sim),
        places=sim.env_origins() * [1.0, 1.0, 0.0],
    )
    made = twin.Twin(described, bodies, physics or twin.Physics(), drive)
    return sim, made, RobotPolicy(network, interface)


@pytest.mark.parametrize("robot", ["spot", "unitree_a1"])
def test_its_sensors_read_what_the_simulator_observes(robot):
    sim, mujoco, policy = make_twin(robot)
    random = np.random.default_rng(0)
    for _ in range(5):
        sim.step(random.normal(size=(4, 12)).astype(np.float32))
    mujoco.reset(sim.qpos(robot), sim.qvel(robot))
    sensors = mujoco.sensors() | {"velocity_commands": sim.command}
    inputs = [torch.from_numpy(np.asarray(sensors[name], dtype=np.float32)) for name in policy.inputs]
    observed = policy.observe(*inputs).numpy()
    wanted = sim.observation.copy()
    wanted[:, 36:48] = 0.0  # no action has been taken yet in MuJoCo
    np.testing.assert_allclose(observed, wanted, atol=1e-4)


@pytest.mark.parametrize("robot", ["spot", "anymal_c"])
def test_efforts_stay_within_the_actuators_limits(robot):
    """Effort towards targets far away: the torque-speed line, or the table over the angle."""
    sim, mujoco, _ = make_twin(robot)
    mujoco.reset(sim.qpos(robot), sim.qvel(robot))
    mujoco._targets[:] = 20.0
    actuators = mujoco.robot.actuators
    saturated = 0
    for _ in range(20):
        position, velocity = mujoco.qpos[:, 7:].copy(), mujoco.qvel[:, 6:].copy()
        allowed = actuators.effort_range(position, velocity)
        mujoco._physics_step(0, np.arange(4), np.zeros(4, dtype=np.bool_))
        effort = np.array([data.actuator_force for data in mujoco._data])
        assert (effort >= allowed[..., 0] - 1e-9).all()
        assert (effort <= allowed[..., 1] + 1e-9).all()
        saturated += int((effort > allowed[..., 1] - 1e-6).sum())
    assert saturated > 100
    limits = actuators.effort_range(np.full((1, 12), -2.0), np.zeros((1, 12)))[0, :, 1]
    if robot == "spot":
        tables = [table for table in actuators.effort_tables if table is not None]
        assert limits.max() == pytest.approx(np.interp(-2.0, tables[0][:, 0], tables[0][:, 1]))
    else:
        # no torque is left at the motor's speed without load
        assert actuators.effort_range(np.zeros(12), actuators.no_load_speed)[:, 1].max() == pytest.approx(0.0)


@pytest.mark.parametrize("delay", [0, 1, 3, 4])
def test_targets_come_as_late_as_the_delay(delay):
    """The second step's target is seen after `delay` physics steps; the first one has no past."""
    sim, mujoco, _ = make_twin("spot", num_envs=1, delay=delay)
    mujoco.reset(sim.qpos("spot"), sim.qvel("spot"))
    seen = []
    step = mujoco._mj.mj_step

    class Spy:
        def __getattr__(self, name):
            return getattr(mujoco_module, name)

        def mj_step(self, model, data):
            seen.append(data.ctrl.copy())
            step(model, data)

    mujoco_module, mujoco._mj = mujoco._mj, Spy()
    for _ in range(2):
        mujoco.step(np.array([[0.5, 0.0, 0.0]], dtype=np.float32), np.ones(1, dtype=np.bool_))
    first, second = seen[0], mujoco._targets[0, 0]
    assert not np.allclose(first, second)
    for substep, target in enumerate(seen[:4] + seen[4:]):
        late = substep < 4 + delay
        np.testing.assert_array_equal(target, first if late else second)


@pytest.mark.parametrize(("limit", "value"), [("least_height", 0.6), ("least_upright", 1.0)])
def test_what_ends_episodes_in_the_task_is_a_fall_in_mujoco(limit, value):
    """Spot stands 0.5 m high and never quite level."""
    sim, mujoco, _ = make_twin("spot", num_envs=2)
    mujoco.reset(sim.qpos("spot"), sim.qvel("spot"))
    commands_of_two = np.zeros((2, 3), dtype=np.float32)
    assert not mujoco.step(commands_of_two, np.ones(2, dtype=np.bool_)).fell.any()
    setattr(mujoco, limit, value)
    assert mujoco.step(commands_of_two, np.array([True, False])).fell.tolist() == [True, False]


def test_what_no_sensor_gives_is_named():
    _, mujoco, _ = make_twin("spot", num_envs=1)
    mujoco.policy.inputs["motor_temperature"] = 1
    with pytest.raises(polypod.ConfigError, match="takes motor_temperature, which no sensor gives in MuJoCo; state"):
        mujoco.step(np.zeros((1, 3), dtype=np.float32), np.ones(1, dtype=np.bool_))


def test_commands_follow_the_heading():
    ranges = {key: np.tile([[-1.0], [1.0]], 400) for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")}
    config = {
        "heading": [-3.0, 3.0],
        "heading_command": True,
        "heading_control_stiffness": 0.5,
        "rel_heading_envs": 1.0,
        "rel_standing_envs": 0.1,
        "rel_turning_envs": 0.0,
        "rel_sideways_envs": 0.0,
        "resampling_time_s": 2.0,
    }
    drawn = commands.Commands.draw(config, ranges, 250, 0.02, seed=0)
    assert drawn.linear.shape == (3, 400, 2)
    at_goal = drawn.at(0, drawn.heading[0])
    np.testing.assert_allclose(at_goal[:, 2], 0.0, atol=1e-6)
    off = drawn.at(120, drawn.heading[1] + 0.4)
    standing = drawn.standing[1]
    assert 10 < standing.sum() < 80
    np.testing.assert_allclose(off[~standing, 2], -0.2, atol=1e-6)
    np.testing.assert_array_equal(off[standing], 0.0)
    np.testing.assert_allclose(off[~standing, :2], drawn.linear[1][~standing], atol=1e-6)


def test_it_walks_in_both_simulators(tmp_path, capsys):
    """By the whole definition of walking, over the same commands."""
    arguments = ["sim2sim", "--checkpoint", str(FLAT_POLICY), "--robots", "anymal_b,anymal_c", "--num-envs", "4"]
    code = polypod.cli.main([*arguments, "--json", str(tmp_path / "figures.json")])
    output = capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert code == 0, output
    assert figures["transfers"]
    assert figures["command"] == " ".join(["polypod", *arguments, "--seed", "0"])
    assert set(figures["robots"]) == {"anymal_b", "anymal_c"}
    for robot in figures["robots"].values():
        assert robot["is_whole"]
        assert robot["why_not"] == []
        assert robot["mujoco"]["fall_rate"] == 0.0
        assert abs(robot["mujoco"]["error_vel_xy"] - robot["polypod"]["error_vel_xy"]) < CLOSE
        assert robot["mujoco"]["episode_length_s"] == pytest.approx(20.0)
        ours, theirs = (walking.Walking.from_dict(robot[engine]["walking"]) for engine in ("polypod", "mujoco"))
        assert walking.walks(theirs)
        assert ours.kinds == theirs.kinds == walking.KINDS
        # the same commands: turns in both directions, side-steps, stops
        for kind in walking.KINDS:
            assert ours.by_kind[kind].count == theirs.by_kind[kind].count > 0
            still = ("still_error_vel_xy", "still_error_vel_yaw")
            assert [getattr(ours.by_kind[kind], key) for key in still] == pytest.approx(
                [getattr(theirs.by_kind[kind], key) for key in still]
            )
        assert theirs.turn_reached == pytest.approx(ours.turn_reached, abs=0.1)
    assert "anymal_b" in output
    assert "in MuJoCo:" not in output


def test_a_robot_transfers_if_it_walks_in_mujoco():
    """Turning and stopping count, whatever the robot does in polypod.

    A part of the definition is judged as a part.
    """
    good = walking.Walking(
        episodes=32,
        duration_s=20.0,
        kinds=walking.KINDS,
        error_vel_xy=0.1,
        still_error_vel_xy=0.46,
        error_vel_yaw=0.1,
        still_error_vel_yaw=0.37,
        fall_rate=0.0,
        turn_reached=0.9,
        side_reached=0.9,
        drift_xy=0.01,
        drift_yaw=0.01,
    )

    def compared(ours, theirs, is_whole=True):
        figures = [sim2sim.Figures(0.1, 0.1, 0.0, 20.0, walking=each) for each in (ours, theirs)]
        return sim2sim.RobotComparison(*figures, is_whole=is_whole)

    assert compared(good, good).transfers
    slow = dataclasses.replace(good, turn_reached=0.5)
    assert compared(slow, good).transfers
    assert compared(good, slow).why_not == ["pure turns reach 50% of what is asked, 60% wanted"]
    assert not compared(good, slow).transfers
    assert not compared(good, dataclasses.replace(good, error_vel_yaw=0.3)).transfers
    assert not compared(good, dataclasses.replace(good, drift_xy=0.06)).transfers
    short = dataclasses.replace(good, duration_s=3.0)
    assert compared(good, short).why_not == ["episodes of 3 s, 20 s wanted"]
    assert compared(good, short, is_whole=False).transfers
    assert not compared(good, dataclasses.replace(short, turn_reached=0.5), is_whole=False).transfers


def test_the_ground_is_the_tasks_own(capsys):
    """MuJoCo's rays hit the ground that polypod's robots stand on, as the twin's scanner does."""
    rough = {"checkpoint": ROUGH_POLICY, "task": "velocity_rough_universal_play", "overrides": SMALL_TERRAIN}
    sim, mujoco, policy = make_twin("unitree_go1", 16, **rough)
    for _ in range(3):
        sim.step(np.zeros((16, 12), dtype=np.float32))
    mujoco.reset(sim.qpos("unitree_go1"), sim.qvel("unitree_go1"))
    sensors = mujoco.sensors() | {"velocity_commands": sim.command}
    inputs = [torch.from_numpy(np.asarray(sensors[name], dtype=np.float32)) for name in policy.inputs]
    wanted = sim.observation.copy()
    # two ways to lie between the same four heights
    np.testing.assert_allclose(policy.observe(*inputs).numpy(), wanted, atol=6e-3)
    assert np.ptp(wanted[:, 83:], axis=1).max() > 0.1
    engine, model, hit = mujoco._mj, mujoco.reference.model, np.zeros(1, dtype=np.int32)
    ground = np.flatnonzero(model.geom_type == engine.mjtGeom.mjGEOM_HFIELD)
    random = np.random.default_rng(0)
    for at in random.uniform([-8.0, -40.0], [8.0, 40.0], size=(size(300, 3000), 2)):
        above, down = np.array([*at, 30.0]), np.array([0.0, 0.0, -1.0])
        distance = engine.mj_ray(model, mujoco._data[0], above, down, None, 1, -1, hit, None)
        if hit[0] == ground[0]:
            # a wall is a slope within a cell, which is cut along either diagonal
            cell = mujoco.heights.cell
            near = [mujoco.heights.at(at + cell * np.array(step)) for step in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
            slack = 0.5 * (max(near) - min(near)) + 1e-4
            assert 30.0 - distance == pytest.approx(float(mujoco.heights.at(at)), abs=slack)


def test_the_ground_in_mujoco_resists_turning_as_the_tasks_does():
    overrides = ("robot_material.torsional_friction=0.02", "scene.ground.torsional_friction=0.01")
    rolling = "scene.ground.rolling_friction=0.005"
    for more, condim, expected in (((), 4, [0.8, 0.02, 0.0]), ((rolling,), 6, [0.8, 0.02, 0.005])):
        options = sim2sim.Options(envs_per_robot=1, steps=2, overrides=(*overrides, *more))
        physics = sim2sim.compare(FLAT_POLICY, ["unitree_a1"], options).physics
        _, mujoco, _ = make_twin("unitree_a1", num_envs=1, physics=physics)
        model = mujoco.reference.model
        assert (model.geom_condim == condim).all()
        assert (model.geom_friction == expected).all()


def test_it_climbs_in_both_simulators():
    overrides = (*SMALL_TERRAIN, "scene.terrain.difficulty_range=[0.0, 0.6]")
    options = sim2sim.Options(envs_per_robot=6, steps=250, overrides=overrides)
    found = sim2sim.compare(ROUGH_POLICY, ["unitree_go1"], options)
    assert found.physics.dt == 0.002
    robot = found.robots["unitree_go1"]
    assert robot.mujoco.fall_rate == 0.0
    assert abs(robot.mujoco.error_vel_xy - robot.polypod.error_vel_xy) < CLOSE


def test_soles_stand_on_level_heights_as_on_a_plane():
    """A height field is a prism per triangle, and a sole touches fifty of them."""
    slope = "slope_range=[0.0, 0.0], platform_width=2.0, border_width=0.25"
    tile = f'{{name="level", type="hf_pyramid_slope", proportion=1.0, {slope}}}'
    terrain = f"scene.terrain={{size=[8.0, 8.0], num_rows=1, num_cols=1, border_width=4.0, sub_terrains=[{tile}]}}"
    options = sim2sim.Options(envs_per_robot=2, steps=120, overrides=(terrain, "scene.grid_cell=0.025"))
    robot = sim2sim.compare(LEGGED_POLICY, ["booster_t1"], options).robots["booster_t1"]
    assert robot.mujoco.fall_rate == 0.0
    assert abs(robot.mujoco.error_vel_xy - robot.polypod.error_vel_xy) < CLOSE
    assert abs(robot.mujoco.error_vel_yaw - robot.polypod.error_vel_yaw) < CLOSE


def test_robots_with_light_joints_take_finer_steps(capsys):
    """At 5 ms PhantomX slides."""
    arguments = ["sim2sim", "--checkpoint", str(LEGGED_POLICY), "--robots", "phantomx,unitree_a1", "--num-envs", "2"]
    polypod.cli.main([*arguments, "--steps", "150", "--command", "0.1", "0", "0"])
    output = capsys.readouterr().out
    assert "implicitfast at 5 ms" in output
    assert "phantomx in MuJoCo: steps of 2 ms" in output
    options = sim2sim.Options(envs_per_robot=2, steps=150, command=(0.1, 0.0, 0.0))
    found = sim2sim.compare(LEGGED_POLICY, ["phantomx", "unitree_a1"], options)
    assert found.finer == {"phantomx": 0.002}
    for robot in found.robots.values():
        assert abs(robot.mujoco.error_vel_xy - robot.polypod.error_vel_xy) < SLIDES
    named = sim2sim.compare(LEGGED_POLICY, ["phantomx"], dataclasses.replace(options, dt=0.005))
    assert not named.finer
    slides = named.robots["phantomx"]
    assert abs(slides.mujoco.error_vel_xy - slides.polypod.error_vel_xy) > SLIDES


def test_finer_steps_make_up_control_steps_of_any_length():
    loaded = load(LEGGED_POLICY)
    options = sim2sim.Options(envs_per_robot=1, overrides=("sim.decimation=3",))
    episode = run.Episode(loaded.manifest, ["phantomx", "unitree_a1"], options)
    for name, interface in interfaces(loaded.manifest, ["phantomx", "unitree_a1"]).items():
        beginning.twin_of(episode, name, name, interface, OnnxPolicy.of(loaded.network, interface))
    assert episode.finer == {"phantomx": pytest.approx(0.015 / 8)}


def test_a_robot_that_slips_does_not_transfer(capsys):
    """On ice in MuJoCo alone; the exit code says so."""
    arguments = ["sim2sim", "--checkpoint", str(FLAT_POLICY), "--robots", "unitree_go2", "--num-envs", "4"]
    assert polypod.cli.main([*arguments, "--steps", "100", "--friction", "0.02", "--command", "1", "0", "0"]) == 3
    output = capsys.readouterr().out
    assert "unitree_go2 in MuJoCo: " in output
    assert "omit --command" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--num-envs", "0"), "num_envs"),
        (("--dt", "0.003"), "does not divide"),
        (("--robots", "spott"), "spot"),
        (("--set", 'scene.obstacles=[{shape="box", size=[1.0, 1.0, 0.1], position=[2.0, 0.0, 0.05]}]'), "obstacles"),
    ],
)
def test_mistakes_get_one_line(capsys, arguments, message):
    assert polypod.cli.main(["sim2sim", "--checkpoint", str(FLAT_POLICY), *arguments]) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


def test_states_that_memory_does_not_hold_are_refused(monkeypatch):
    """MuJoCo's own error is none of Python's; the message names what to lower."""
    import mujoco

    from polypod.mujoco_model import reference

    class Starved:
        """MuJoCo on a machine with little memory."""

        FatalError = mujoco.FatalError

        @staticmethod
        def MjData(model):  # noqa: N802
            """As MuJoCo raises it."""
            raise mujoco.FatalError("Could not allocate memory")

    monkeypatch.setattr(reference, "mujoco", lambda: Starved)
    with pytest.raises(polypod.ConfigError, match=r"no memory for 1000 states .*choose a smaller --num-envs"):
        reference.states(None, 1000, "--num-envs")
    monkeypatch.setattr(Starved, "MjData", staticmethod(lambda model: (_ for _ in ()).throw(MemoryError)))
    with pytest.raises(polypod.ConfigError, match=r"no memory for 7 states .*choose a smaller --threads"):
        reference.states(None, 7, "--threads")


class _FirstFalls:
    """A simulation whose first env has fallen after four steps."""

    def __init__(self, sim):
        self._sim, self._steps = sim, 0

    def __getattr__(self, name):
        return getattr(self._sim, name)

    def step(self, actions):
        self._steps += 1
        self._sim.step(actions)

    @property
    def terminated(self):
        return np.array([self._steps >= 4, False])


def test_a_policy_that_diverges_in_a_robot_that_fell_ends_nothing():
    """No step takes actions of 1e9, and those of a robot that lies on the ground are not judged."""
    options = beginning.Options(envs_per_robot=2, steps=12, command=(0.0, 0.0, 0.0))
    episode = run.Episode(run_dir.read_manifest(FLAT_POLICY), ["spot"], options)
    episode.sim = _FirstFalls(episode.sim)
    fallen = np.zeros(2, dtype=np.bool_)

    def policy(observation):
        actions = np.zeros((2, episode.sim.num_actions), dtype=np.float32)
        actions[fallen] = 1e9
        return actions

    def seen(velocity, yaw_rate, fell):
        fallen[:] |= fell

    figures = run.run_polypod(episode, policy, lambda *_: None, None, seen)["spot"]
    assert fallen.tolist() == [True, False]
    assert figures.fall_rate == 0.5
