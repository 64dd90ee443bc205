"""The battery of `polypod robustness` changes what its rows say, and its bounds decide.

Figures repeat.
"""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

import polypod
from common import FLAT_POLICY, ROOT, size
from polypod import _core, policy, robustness
from polypod.compat import tomllib
from polypod.evaluation.walking import SIDE, STOP, TURN, Record, Schedule
from polypod.robustness import body, conditions, in_polypod, results, schedules, twins

pytest.importorskip("mujoco")

from polypod.robustness.in_mujoco import Mujoco, PolicyPerEnv  # it needs MuJoCo

ROBOTS = ("unitree_go1", "spot")
BY_NAME = {entry.name: entry for entry in robustness.CONDITIONS}
SOME_BODY = body.Body("spot", "spot", "quadruped", ("hips", "knees"), 10.0, 0.5, {})
PHYSICAL = [entry.name for entry in robustness.CONDITIONS if entry.overrides(SOME_BODY) or entry.delay_s > 0.0]
"""Conditions that change a robot or its surface."""


@pytest.fixture(scope="module")
def loaded():
    return policy.load(FLAT_POLICY)


def setting_of(loaded, robots=ROBOTS, steps=20, given=(), threads=1):
    return in_polypod.Setting.of(loaded.manifest, robots, given=tuple(given), seed=3, steps=steps, threads=threads)


@pytest.fixture(scope="module")
def nominal(loaded):
    return in_polypod.Nominal.of(setting_of(loaded), 2)


@pytest.fixture(scope="module")
def mujoco(loaded):
    return Mujoco(loaded, setting_of(loaded), 2)


# Changes of the conditions


PRIVATE = "contact_friction", "base_mass_offset", "base_com_offset"
JOINTS = {"effort": 9, "stiffness": 11, "damping": 12, "armature": 13, "dry_friction": 14}
"""Numbers of the term `joint_descriptors` for each joint."""
JOINT_TASK = "velocity_flat_joints_play"
"""Observes them."""


def in_simulator(nominal, condition, robot):
    """Numbers of a robot in polypod, as it reads them back.

    Privileged terms, and those of joints by their names.
    """
    group = "observations.critic=[" + ", ".join(f'{{term="{term}"}}' for term in PRIVATE) + "]"
    changes = in_polypod.changes_of(BY_NAME[condition], {robot: nominal.robots[robot]}, nominal.physics_dt)
    sim = _core.VecSim(JOINT_TASK, 1, robots=[robot], threads=1, overrides=[group, *changes])
    read = {}
    for of, observed in (("critic", sim.observation_of("critic")), ("policy", sim.observation)):
        start = 0
        for term in json.loads(sim.observation_terms(of)):
            read[term["term"]] = observed[0, start : start + term["size"]].astype(np.float64)
            start += term["size"]
    joints = read["joint_descriptors"].reshape(-1, 12)
    config = tomllib.loads(sim.resolved_config())
    return {**read, **{name: joints[index] for name, index in JOINTS.items()}, "config": config}


EXPECTED = {
    **{f"friction_{value}": ("contact_friction", [value, 0.75 * value]) for value in (0.3, 0.4, 0.6, 1.0, 1.2)},
    **{f"armature_{value}": ("armature", np.full(12, 10.0 * value)) for value in (0.0, 0.03)},
    **{f"dry_friction_{value}": ("dry_friction", np.full(12, value)) for value in (0.2, 0.5)},
}
"""Values that polypod reads back, for Go1 as for Spot."""


@pytest.mark.parametrize("robot", size(ROBOTS[:1], ROBOTS))
def test_each_condition_changes_what_it_says_in_polypod(nominal, robot):
    usual = in_simulator(nominal, "nominal", robot)
    known = nominal.robots[robot]
    checked = {"nominal"}

    def read(name):
        checked.add(name)
        return in_simulator(nominal, name, robot)

    for name, (key, value) in EXPECTED.items():
        np.testing.assert_allclose(read(name)[key], value, rtol=1e-5, atol=1e-7, err_msg=name)
    for name, share in (("payload_plus_20", 0.2), ("payload_minus_20", -0.2)):
        np.testing.assert_allclose(read(name)["base_mass_offset"], share * known.trunk_mass, rtol=1e-5)
    for name, shift in (("com_forward", [0.1, 0.0]), ("com_backward", [-0.1, 0.0]), ("com_left", [0.0, 0.05])):
        np.testing.assert_allclose(
            read(name)["base_com_offset"], [*(np.array(shift) * known.height), 0.0], rtol=1e-5, atol=1e-7
        )
    weak = read("torque_minus_20")
    for key in ("effort", "stiffness", "damping"):
        np.testing.assert_allclose(weak[key], 0.8 * usual[key], rtol=1e-5, err_msg=key)
    for value in (0.0, 0.5, 1.0, 2.0):
        groups = read(f"joint_damping_{value}")["config"]["robots"][robot]["actuators"]
        assert {group["joint_damping"] for group in groups.values()} == {value}
    for ms in (10, 20):
        event = read(f"delay_{ms}")["config"]["task"]["events"]["action_delay"]
        assert event["enabled"]
        assert event["delay_range"] == [ms // 5, ms // 5]
    spinning = {name for name in PHYSICAL if BY_NAME[name].family in ("torsional_friction", "rolling_friction")}
    for name in spinning:
        material = read(name)["config"]["task"]["robot_material"]
        wanted = (BY_NAME[name].torsional, twins.ROLLING if BY_NAME[name].family == "rolling_friction" else 0.0)
        assert (material["torsional_friction"], material.get("rolling_friction", 0.0)) == wanted
    assert checked == {"nominal", *PHYSICAL}


def model_of(mujoco, nominal, condition, condim=3, robot="unitree_go1"):
    twin = mujoco.twin(BY_NAME[condition], condim, nominal.robots[robot])
    return twin, twin.reference.model


def test_each_condition_changes_what_it_says_in_mujoco(mujoco, nominal):
    usual, model = model_of(mujoco, nominal, "nominal")
    joints = usual.reference.v[6:]
    checked = set()

    def change(name, condim=3):
        checked.add(name)
        return model_of(mujoco, nominal, name, condim)

    for value in (0.3, 0.4, 0.6, 1.0, 1.2):
        assert set(change(f"friction_{value}")[1].geom_friction[:, 0]) == {value}
    for field, family, values in (
        ("dof_damping", "joint_damping", (0.0, 0.5, 1.0, 2.0)),
        ("dof_frictionloss", "dry_friction", (0.2, 0.5)),
        ("dof_armature", "armature", (0.0, 0.03)),
    ):
        for value in values:
            numbers = getattr(change(f"{family}_{value}")[1], field)
            assert set(numbers[joints]) == {value}
            assert not numbers[usual.reference.v[:6]].any()
    trunk = model.body_weldid == model.body(usual.reference.root).id
    for name, factor in (("payload_plus_20", 1.2), ("payload_minus_20", 0.8)):
        loaded = change(name)[1]
        np.testing.assert_allclose(loaded.body_mass, np.where(trunk, factor, 1.0) * model.body_mass)
        np.testing.assert_allclose(loaded.body_inertia, np.where(trunk, factor, 1.0)[:, None] * model.body_inertia)
        # numbers that MuJoCo derives from it change with it
        np.testing.assert_allclose(loaded.body_subtreemass[0], loaded.body_mass.sum())
        # the trunk is the one of polypod
        np.testing.assert_allclose(model.body_mass[trunk].sum(), nominal.robots["unitree_go1"].trunk_mass)
    height = nominal.robots["unitree_go1"].height
    for name, shift in (("com_forward", [0.1, 0.0]), ("com_backward", [-0.1, 0.0]), ("com_left", [0.0, 0.05])):
        shifted = change(name)[0]
        share = model.body_mass[trunk].sum() / model.body_mass.sum()
        moved = com_about_base(shifted) - com_about_base(usual)
        np.testing.assert_allclose(moved, np.array([*shift, 0.0]) * height * share, atol=1e-9)
    weak, weaker = change("torque_minus_20")
    np.testing.assert_allclose(weaker.actuator_gainprm[:, 0], 0.8 * model.actuator_gainprm[:, 0])
    np.testing.assert_allclose(weaker.actuator_biasprm[:, 1:3], 0.8 * model.actuator_biasprm[:, 1:3])
    at = np.zeros((1, 12)), np.full((1, 12), 5.0)
    np.testing.assert_allclose(weak.robot.actuators.effort_range(*at), 0.8 * usual.robot.actuators.effort_range(*at))
    for ms in (10, 20):
        np.testing.assert_allclose(change(f"delay_{ms}")[0].delays - usual.delays, 1e-3 * ms)
    for name in ("torsional_friction_0.005", "torsional_friction_0.01", "torsional_friction_0.02"):
        ((condim,), value) = BY_NAME[name].condims, BY_NAME[name].torsional
        turned = change(name, condim)[1]
        assert (set(turned.geom_condim), set(turned.geom_friction[:, 1])) == ({4}, {value})
        assert not turned.geom_friction[:, 2].any()
    rolled = change("rolling_friction_0.01", 6)[1]
    assert set(rolled.geom_condim) == {6}
    np.testing.assert_array_equal(rolled.geom_friction[:, 1:], np.tile([0.02, 0.01], (rolled.ngeom, 1)))
    assert checked == set(PHYSICAL)


def com_about_base(twin):
    """The robot's centre of mass about its base, base axes, in MuJoCo's reference pose."""
    import mujoco as mj

    model = twin.reference.model
    data = mj.MjData(model)
    mj.mj_kinematics(model, data)
    mj.mj_comPos(model, data)
    root = model.body(twin.reference.root).id
    return data.xmat[root].reshape(3, 3).T @ (data.subtree_com[root] - data.xpos[root])


def test_the_simulators_stand_on_the_contacts_that_their_names_say(mujoco, nominal):
    for condim in conditions.CONDIMS:
        model = model_of(mujoco, nominal, "turn", condim)[1]
        assert set(model.geom_condim) == {condim}
        assert set(model.geom_friction[:, 1]) == {0.0 if condim == 3 else twins.TORSIONAL}
        assert set(model.geom_friction[:, 2]) == {twins.ROLLING if condim == 6 else 0.0}


def test_the_trunk_is_all_that_no_moving_joint_separates():
    links = "".join(
        f'<link name="{name}"><inertial><mass value="{mass}"/></inertial></link>'
        for name, mass in (("above", 1.0), ("base", 2.0), ("box", 4.0), ("lid", 8.0), ("leg", 16.0), ("foot", 32.0))
    )
    joints = "".join(
        f'<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/></joint>'
        for parent, child in (("above", "base"), ("base", "box"), ("box", "lid"), ("base", "leg"), ("leg", "foot"))
    )
    urdf = f'<robot name="r">{links}{joints}</robot>'
    assert body.trunk_mass(urdf, "base", ["leg_joint"]) == 15.0
    assert body.trunk_mass(urdf, "base", ["leg_joint", "box_joint"]) == 3.0


@pytest.mark.parametrize("robot", size(["unitree_g1"], ["unitree_g1", "cassie", "anymal_b_kinova", "unitree_go2w"]))
def test_payloads_of_other_bodies_are_of_the_same_trunk_in_both_simulators(robot):
    """Arms, locked joints and fixed links."""
    sim = _core.VecSim("velocity_flat_legged_play", 1, robots=[robot], threads=1)
    ((_, known),) = body.bodies(sim, [robot]).items()
    from polypod.mujoco_model.reference import Reference
    from polypod.mujoco_model.robot import of

    reference = Reference.of(of(sim, robot, robot), dt=0.005)
    model = reference.model
    trunk = model.body_weldid == model.body(reference.root).id
    assert known.trunk_mass == pytest.approx(model.body_mass[trunk].sum(), rel=1e-9)
    assert 0.0 < known.trunk_mass < model.body_mass.sum()


# Commands of the policy


class Watching:
    """A policy that stands and remembers what it was shown."""

    def __init__(self):
        """Has seen nothing."""
        self.seen = []

    def __call__(self, observations):
        """Zeros."""
        self.seen.append(observations.copy())
        return np.zeros((len(observations), 12), dtype=np.float32)


def shown(loaded, nominal, condition, steps=20):
    watching = Watching()
    setting = setting_of(loaded, steps=steps)
    in_polypod.run(setting, nominal, BY_NAME[condition], watching, 2, lambda done, total: None)
    return np.array(watching.seen)


def test_a_payload_is_not_told_and_a_wrong_description_is(loaded, nominal):
    columns = nominal.columns
    assert len(columns) == 35
    told = shown(loaded, nominal, "payload_plus_20", 3)[..., columns]
    np.testing.assert_array_equal(told, np.tile(nominal.described, (3, 1, 1)))
    wrong = shown(loaded, nominal, "description_20", 3)[..., columns]
    np.testing.assert_array_equal(wrong, np.tile(wrong[0], (3, 1, 1)))
    known = nominal.described != 0.0
    factors = wrong[0][known] / nominal.described[known]
    assert factors.min() >= 0.8 - 1e-6
    assert factors.max() <= 1.2 + 1e-6
    assert factors.std() > 0.05
    # each env has its own errors
    assert not np.allclose(wrong[0][0], wrong[0][1])


def test_a_wrong_description_is_folded_into_the_policies_of_mujoco(mujoco, nominal):
    twin, _ = model_of(mujoco, nominal, "description_20")
    usual, _ = model_of(mujoco, nominal, "nominal")
    assert isinstance(twin.policy, PolicyPerEnv)
    inputs = {name: np.ones((2, width), dtype=np.float32) for name, width in usual.policy.inputs.items()}
    right, wrong = usual.policy(**inputs)["actions"], twin.policy(**inputs)["actions"]
    np.testing.assert_allclose(right[0], right[1], atol=1e-6)
    assert np.abs(wrong - right).max(axis=1).min() > 1e-4
    assert not np.allclose(wrong[0], wrong[1], atol=1e-4)


def test_commands_show_in_the_observation_of_their_first_step(loaded, nominal):
    seen = shown(loaded, nominal, "commands_2s", steps=102)[..., 9:12]
    schedule = in_polypod.schedules_of(BY_NAME["commands_2s"], setting_of(loaded).sim(2), nominal.robots, 102, 3)[0]
    assert schedule.steps_per_segment == 100
    for step in (0, 1, 99, 100, 101):
        np.testing.assert_array_equal(seen[step], schedule.at(step))
    assert not np.array_equal(seen[99], seen[100])


def test_pushes_are_those_of_the_list_in_both_simulators(loaded, nominal, mujoco):
    pushes = schedules.Pushes.draw(2, 1000, 0.02, 3)
    at = [step for step in range(1000) if pushes.at(step) is not None]
    assert at == [125, 375, 625, 875]
    assert 0.05 < np.abs(pushes.velocities[..., :2]).max() <= schedules.PUSH_SPEED
    assert not pushes.velocities[..., 2].any()
    twin, _ = model_of(mujoco, nominal, "pushes")
    before = twin.qvel[:, :3].copy()
    twin.push(pushes.at(125))
    np.testing.assert_allclose(twin.qvel[:, :3] - before, pushes.at(125), atol=1e-9)
    calm, pushed = (shown(loaded, nominal, name, steps=127)[..., :2] for name in ("nominal", "pushes"))
    np.testing.assert_array_equal(calm[:126], pushed[:126])
    assert np.abs(pushed[126] - calm[126]).max() > 0.05


def test_turns_side_steps_and_stops():
    ranges = {"lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-0.4, 0.4), "ang_vel_z": (-1.0, 1.0)}
    turns = schedules.turns(ranges, 3, 1000, 0.02, 0)
    np.testing.assert_allclose(turns.commands[:, 0, 2], [0.6, -0.6, 0.6, -0.6])
    np.testing.assert_allclose(turns.commands[:, 1, 2], [-0.6, 0.6, -0.6, 0.6])
    assert set(turns.kinds.ravel()) == {TURN}
    sides = schedules.side_steps(ranges, 2, 1000, 0.02, 0)
    np.testing.assert_allclose(sides.commands[:, 0, 1], [0.4, -0.4, 0.4, -0.4])
    assert set(sides.kinds.ravel()) == {SIDE}
    stops = schedules.stops(ranges, 2, 1000, 0.02, 0)
    assert set(stops.kinds[1::2].ravel()) == {STOP}
    assert not stops.commands[1::2].any()
    assert np.abs(stops.commands[::2]).max(axis=2).min() > 0.0
    assert schedules.turns({**ranges, "ang_vel_z": (0.0, 0.0)}, 2, 1000, 0.02, 0) is None
    # a box with one direction
    left = schedules.turns({**ranges, "ang_vel_z": (0.0, 0.5)}, 2, 1000, 0.02, 0)
    assert set(left.commands[..., 2].ravel()) == {np.float32(0.5)}


# Verdicts


def recorded(fell_of=0, envs=100, command=(0.5, 0.0, 0.0), motion=(0.5, 0.0, 0.0), steps=10):
    """A record of envs that move like this, the first of which fall in their last step."""
    record = Record(Schedule.constant(command, envs, steps), 0.02)
    moves = np.tile(motion, (envs, 1))
    for step in range(steps):
        record.add(moves[:, :2], moves[:, 2], (np.arange(envs) < fell_of) & (step == steps - 1))
    return record


def faults(bound, **how):
    return results.cell(recorded(**how), slice(None), bound, whole=False).faults


def test_bounds_are_the_most_that_is_allowed():
    bound = conditions.Bound(falls=0.03)
    assert not faults(bound, fell_of=3)
    assert faults(bound, fell_of=4) == ("falls in 4.0% of the episodes, 3% allowed",)
    turning = conditions.Bound(falls=1.0, turn_error=0.15)
    assert not faults(turning, command=(0.0, 0.0, 0.6), motion=(0.0, 0.0, 0.46))
    assert faults(turning, command=(0.0, 0.0, 0.6), motion=(0.0, 0.0, 0.44)) == (
        "turns with an error of 0.160 rad/s, 0.15 allowed",
    )
    # a turn that was not measured is not within
    assert faults(turning)
    half = recorded(fell_of=0)
    half._steps[:, :50] = 5.0
    kept = results.cell(half, slice(None), conditions.Bound(kept=0.85), whole=False)
    assert kept.kept == pytest.approx(0.75)
    assert kept.faults == ("keeps 75% of the episode, 85% wanted",)
    walks = conditions.Bound(walks=True)
    assert not faults(walks)
    assert faults(walks, motion=(0.0, 0.0, 0.0))


def test_bipeds_and_humanoids_may_miss_twice_as_much(nominal):
    quadruped = nominal.robots["spot"]
    bound = conditions.Bound(falls=0.05, turn_error=0.15, kept=0.85, walks=True)
    assert bound.of(quadruped) == bound
    assert bound.of(dataclasses.replace(quadruped, kind="hexapod")) == bound
    for kind in ("biped", "humanoid"):
        wider = bound.of(dataclasses.replace(quadruped, kind=kind))
        assert (wider.falls, wider.turn_error, wider.walks) == (0.1, 0.3, True)
        assert wider.kept == pytest.approx(0.7)


def battery_of(fell_of):
    cell = results.cell(recorded(fell_of), slice(None), conditions.Bound(), whole=False)
    row = results.Row("friction_0.4", "friction 0.4", "polypod", {"spot": cell}, {"cassie": "it has none"})
    measured = {"date": "2026-01-01", "machine": "m", "commit": "c"}
    origin = {"file": "flat", "sha256": "0"}
    return results.Battery(
        origin, "polypod robustness", "T", 0, 20.0, {"polypod": 100}, ["spot", "cassie"], [row], measured
    )


def test_the_exit_code_is_that_of_the_bounds(cli, monkeypatch, tmp_path):
    for fell_of, code in ((5, 0), (6, 3)):
        monkeypatch.setattr(robustness, "measure", lambda *given, fell_of=fell_of: battery_of(fell_of))
        out = tmp_path / "out.json"
        ended = cli("robustness", "--checkpoint", "flat", "--json", str(out))
        assert ended.returncode == code
        assert ("spot: falls in 6.0%" in ended.stdout) == (code == 3)
        assert "not applicable for cassie: it has none" in ended.stdout
        assert json.loads(out.read_text())["is_within"] == (code == 0)


def test_nothing_measured_is_not_within():
    battery = battery_of(0)
    assert battery.is_within
    rows = [dataclasses.replace(row, robots={}) for row in battery.rows]
    assert not dataclasses.replace(battery, rows=rows).is_within


def test_json_holds_all():
    battery = battery_of(7)
    content = json.loads(json.dumps(battery.as_dict(), allow_nan=False))
    again = results.Battery.from_dict(content)
    assert again.as_dict() == battery.as_dict()
    cell = again.rows[0].robots["spot"]
    assert math.isnan(cell.turn_error)
    assert cell.faults == battery.rows[0].robots["spot"].faults


def test_the_picture_has_both_panels(tmp_path):
    pytest.importorskip("matplotlib")
    from polypod.robustness import picture

    battery = battery_of(7)
    np.testing.assert_allclose(picture.values(battery, "fall_rate"), [[0.07, np.nan]])
    picture.draw(battery, tmp_path / "battery.png")
    assert (tmp_path / "battery.png").read_bytes().startswith(b"\x89PNG")


def test_unknown_names_are_refused_with_suggestions(cli):
    for words, message in (
        (("--conditions", "frction_0.4"), "there is no condition 'frction_0.4'; did you mean 'friction_0.4'"),
        (("--conditions", ""), "there is no condition ''"),
        (("--simulators", "polypod,mujuco"), "there is no simulator 'mujuco'; use polypod or mujoco"),
        (("--condims", "5"), "--condims 5 must be 3, 4 or 6"),
        (("--num-envs", "0"), "--num-envs 0 must be from 1"),
        (("--mujoco-envs", "-1"), "--mujoco-envs -1 must be from 1"),
        (("--steps", "0"), "--steps 0 must be from 1"),
        (("--robots", "spott"), "spot"),
    ):
        ended = cli("robustness", "--checkpoint", "flat", *words)
        assert ended.returncode == 2
        assert message in ended.stderr
        assert ended.stderr.count("\n") == 1


def test_families_stand_for_their_conditions():
    names = [entry.name for entry in robustness.CONDITIONS]
    assert len(set(names)) == len(names)
    assert [entry.name for entry in robustness.chosen(["turn", "payload"])] == [
        "payload_plus_20",
        "payload_minus_20",
        "turn",
    ]
    assert robustness.chosen(None) == robustness.CONDITIONS


# The whole


def figures_of(battery):
    """All figures, without when and how they came about."""
    return json.dumps(battery.as_dict()["rows"])


def test_figures_depend_on_the_seed_and_not_on_the_threads():
    names = ("nominal", "pushes", "description_20")
    options = robustness.Options(names, num_envs=3, mujoco_envs=2, steps=12, seed=1, condims=(3,), threads=1)
    alone = robustness.measure(FLAT_POLICY, ROBOTS, options)
    together = robustness.measure(FLAT_POLICY, ROBOTS, dataclasses.replace(options, threads=2))
    assert figures_of(alone) == figures_of(together)
    assert [(row.condition, row.simulator) for row in alone.rows] == [
        (name, simulator) for name in ("nominal", "description_20", "pushes") for simulator in ("polypod", "mujoco-3")
    ]
    assert all(list(row.robots) == list(ROBOTS) for row in alone.rows)
    other = robustness.measure(FLAT_POLICY, ROBOTS, dataclasses.replace(options, seed=2, simulators=("polypod",)))
    assert figures_of(other) not in figures_of(alone)


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """A policy that always gives zeros, of a task that does not describe the robot."""

    class Zeros(torch.nn.Module):
        def forward(self, observations):
            return 0.0 * observations[:, :12]

    env = polypod.make("velocity_flat", robots=["spot"], num_envs=1, threads=1)
    path = policy.save_onnx(Zeros(), env, tmp_path_factory.mktemp("standing") / "zeros.onnx")
    env.close()
    return path


def test_a_policy_that_stands_is_not_within(standing):
    options = robustness.Options(("nominal", "turn"), ("polypod",), num_envs=4, steps=50, threads=1)
    battery = robustness.measure(standing, options=options)
    assert not battery.is_within
    nominal, turn = (row.robots["spot"] for row in battery.rows)
    assert nominal.fall_rate == turn.fall_rate == 0.0
    assert any("of standing still's" in fault for fault in nominal.faults)
    assert turn.faults
    assert 0.5 < turn.turn_error < 0.7


def test_what_does_not_apply_is_said(standing):
    options = robustness.Options(("description_20", "randomized"), num_envs=2, mujoco_envs=1, steps=3, threads=1)
    battery = robustness.measure(standing, options=options)
    described, in_mujoco, randomized, elsewhere = battery.rows
    reason = "the observation does not describe the robot"
    assert described.not_applicable == in_mujoco.not_applicable == {"spot": reason}
    assert not described.robots
    assert list(randomized.robots) == ["spot"]
    assert elsewhere.not_applicable == {"spot": "the randomisation of a training is polypod's alone"}


def test_the_randomisation_is_that_of_the_training(loaded):
    config = tomllib.loads(setting_of(loaded).sim(1, randomized=True).resolved_config())["task"]
    assert config["observations"]["enable_noise"]
    assert all(config["events"][name]["enabled"] for name in ("push_robot", "physics_material", "base_com"))
    calm = tomllib.loads(setting_of(loaded).sim(1).resolved_config())["task"]
    assert not calm["observations"]["enable_noise"]
    assert not calm["events"]["push_robot"]["enabled"]


def test_the_page_lists_all_conditions():
    """With what they change, their bounds and where they run."""

    def bounds(bound):
        yield from [f"falls {100.0 * bound.falls:g} %"] if bound.falls < 1.0 else []
        yield from [f"turn err {bound.turn_error:g} rad/s"] if bound.turn_error is not None else []
        yield from [f"keeps {100.0 * bound.kept:g} %"] if bound.kept is not None else []
        yield from ["walks"] if bound.walks else []

    rows = [
        f"| `{entry.name}` | {entry.varies} | {', '.join(bounds(entry.bound))} | "
        f"{'-' if entry.twin is None else ', '.join(map(str, entry.condims))} |"
        for entry in robustness.CONDITIONS
    ]
    page = (ROOT / "docs" / "robustness.md").read_text(encoding="utf-8")
    head = "| condition | what it changes | bounds | MuJoCo |\n|---|---|---|---|\n"
    assert head + "\n".join(rows) + "\n\n" in page
