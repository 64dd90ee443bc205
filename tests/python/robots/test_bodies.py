"""`polypod bodies generate` makes bodies that stand in one batch.

The same seed gives the same bodies.
"""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import tomllib

import polypod
from common import size
from lab import bodies_coverage
from polypod import _core, bodies, rotations
from polypod import files as files_of_polypod
from polypod.accuracy.statics import relative_error
from polypod.mujoco_model import reference

COUNT = size(20, 200)


def files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def library(tmp_path, monkeypatch):
    folder = tmp_path / "drawn"
    made = bodies.generate(folder, COUNT, seed=3)
    monkeypatch.setenv("POLYPOD_PATH", str(folder))
    return made


def test_the_seed_decides_them(tmp_path):
    bodies.generate(tmp_path / "a", 10, seed=1)
    bodies.generate(tmp_path / "b", 10, seed=1)
    bodies.generate(tmp_path / "c", 10, seed=2)
    a, b, c = (files(tmp_path / name) for name in "abc")
    assert a == b
    robots = [name for name in a if name.endswith("robot.urdf")]
    assert len(robots) == 10
    assert all(a[name] != c[name] for name in robots)
    assert json.loads(a["bodies.json"])["seed"] == 1


def test_more_bodies_change_none(tmp_path):
    few, more = bodies.generate(tmp_path / "few", 6), bodies.generate(tmp_path / "more", 8)
    assert few == more[:6]


def test_light_bases_keep_a_mass(tmp_path, monkeypatch):
    """A tenth of the robot's mass may exceed its base's: randomisation leaves some of it."""
    bodies.generate(tmp_path / "legs", 80, seed=31, kinds=["biped", "humanoid", "biped", "humanoid", "hexapod"])
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "legs"))
    polypod.make(bodies.TASK, 80)


def test_a_base_of_some_grams_keeps_what_a_simulation_asks_for(tmp_path):
    """A tenth of this robot's 0.4 kg leaves 8 g of its base."""
    body = bodies.draw("humanoid", "light", np.random.default_rng([112, 66]), wide=True)
    (tmp_path / "assets" / "robots" / "light").mkdir(parents=True)
    (tmp_path / "assets" / "robots" / "light" / "robot.urdf").write_text(bodies.urdf(body))
    (tmp_path / "light.toml").write_text(bodies.toml(body, 112))
    polypod.make("velocity_flat_two_legs", 1, robots=[str(tmp_path / "light.toml")])


@pytest.mark.parametrize("grams", [12, 15, 20, 40])
def test_a_draft_of_a_light_base_loads(cli, grams, tmp_path):
    body = bodies.draw("humanoid", "light", np.random.default_rng([112, 66]), wide=True)
    base = dataclasses.replace(body.links[0], mass=0.001 * grams)
    light = dataclasses.replace(body, links=[base, *body.links[1:]])
    (tmp_path / "robot.urdf").write_text(bodies.urdf(light))
    done = cli("robot", "new", "robot.urdf", "--out", "light.toml")
    assert done.returncode == 0, done.stderr
    polypod.make("velocity_flat_two_legs", 1, robots=[str(tmp_path / "light.toml")])


def test_the_librarys_quadrupeds_lie_within_what_is_drawn():
    """Mass, height, drive and action scale of each, in shares of weight and leg length."""
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(size(300, 3000)):
        body = bodies.draw("quadruped", "x", rng)
        drive = body.drives["legs"]
        drawn.append([body.mass / body.leg_length**3, drive.stiffness, drive.effort, body.action_scale])
    low, high = np.min(drawn, axis=0), np.max(drawn, axis=0)
    sim = _core.VecSim("velocity_flat_legged_play", 24)
    info = json.loads(sim.robot_info())
    count = 0
    for robot in sim.robots:
        own = info[robot]
        if own["class"] != "quadruped" or len(own["joint_names"]) != 12:
            continue
        count += 1
        # legs are a little longer than the base is high
        leg = own["base_height"] / 0.82
        load = own["mass"] * _core.EARTH_GRAVITY * leg
        stiffness, effort = np.median(own["stiffness"]) / load, np.median(own["effort_limit"]) / load
        found = [own["mass"] / leg**3, stiffness, effort, own["action_scale"]]
        assert (low * 0.95 <= found).all(), (robot, found, low)
        assert (found <= high * 1.05).all(), (robot, found, high)
    assert count >= 14


def test_masses_follow_lengths():
    rng = np.random.default_rng(0)
    drawn = [bodies.draw("quadruped", "x", rng) for _ in range(200)]
    lengths = np.log([body.leg_length for body in drawn])
    slope, _ = np.polyfit(lengths, np.log([body.mass for body in drawn]), 1)
    assert slope == pytest.approx(3.0, abs=0.2)
    assert min(np.exp(lengths)) < 0.3
    assert max(np.exp(lengths)) > 0.8


def test_they_are_of_all_kinds_and_stand_in_one_batch(library):
    """Two legs begin to fall slowly without a policy, as those of machines do.

    So do few of the others, on soft and narrow legs.
    """
    names = [body.name for body in library]
    env = polypod.make(bodies.TASK + "_play", COUNT, seed=0, autoreset="disabled")
    assert env.robots == names
    env.reset()
    balanced = np.array([body.kind in ("biped", "humanoid") for body in library])
    actions = np.zeros((COUNT, env.sim.num_actions), dtype=np.float32)
    fallen = np.zeros(COUNT, dtype=np.bool_)
    for step in range(300):
        ended = env.step(actions)[2]
        fallen |= ended
        if ended.any():
            assert step > 25
            env.reset(options={"reset_mask": ended})
    assert fallen[~balanced].mean() <= 0.05, np.array(names)[fallen & ~balanced]
    assert env.state.valid.all()
    joints = {body.kind: {len(other.joints) for other in library if other.kind == body.kind} for body in library}
    assert set(joints) == set(bodies.BY_DEFAULT)
    assert joints["quadruped"] == {12}
    assert joints["quadruped8"] == {8}
    assert joints["hexapod"] == {18}
    assert joints["biped"] <= {6, 10, 12}
    assert min(joints["humanoid"]) >= 16


def test_an_arm_rides_on_the_quadruped_of_the_same_draw(tmp_path, monkeypatch):
    """Its joints have separate slots, and few of these bodies fall by the weight of it."""
    made = bodies.generate(tmp_path / "arms", 12, seed=30, kinds=["quadruped_arm"], prefix="a")
    without = [bodies.draw("quadruped", body.name, np.random.default_rng([30, i])) for i, body in enumerate(made)]
    for body, legs in zip(made, without, strict=True):
        assert body.links[: len(legs.links)] == legs.links
        assert body.joints[:12] == legs.joints
        assert all(joint.name.startswith("ARM_") for joint in body.joints[12:])
        assert 1.03 * legs.mass <= body.mass <= 1.13 * legs.mass
    assert {15, 16, 17} <= {len(body.joints) for body in made} <= {15, 16, 17, 18}
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "arms"))
    env = polypod.make(bodies.TASK + "_play", 12, seed=0, autoreset="same_step")
    env.reset()
    actions = np.zeros((12, env.sim.num_actions), dtype=np.float32)
    fallen = np.zeros(12, dtype=np.bool_)
    for _ in range(300):
        fallen |= env.step(actions)[2]
    assert fallen.sum() <= 1


def test_roles_follow_from_geometry(library, tmp_path):
    """The names that the configs state are those that geometry finds."""
    for body in library:
        path = tmp_path / "drawn" / "configs" / "robots" / f"{body.name}.toml"
        text = path.read_text()
        stated = tomllib.loads(text)["joint_roles"]
        begin, end = text.index("[joint_roles]"), text.index("[default_pose]")
        path.write_text(text[:begin] + text[end:])
        (info,) = json.loads(_core.VecSim("velocity_flat_any_legged_play", 1, robots=[body.name]).robot_info()).values()
        assert set(info["joint_names"]) == set(stated)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("kind", bodies.KINDS)
def test_mujoco_reads_them_alike(kind, wide, tmp_path):
    pytest.importorskip("mujoco")
    body = bodies.draw(kind, "drawn", np.random.default_rng(5), wide)
    file = tmp_path / "robot.urdf"
    file.write_text(bodies.urdf(body))
    sim = polypod.Simulation(str(file), ground=None, self_collision=False, threads=1)
    mujoco = reference.Reference(file.read_text(), joint_names=tuple(sim.joint_names), dt=sim.dt)
    assert sim.total_mass == pytest.approx(body.mass, rel=1e-5)
    rng = np.random.default_rng(0)
    qpos = np.concatenate([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0], rng.uniform(-0.5, 0.5, len(body.joints))])
    sim.set_state(qpos, np.zeros(6 + len(body.joints)))
    mujoco.set_state(qpos)
    assert relative_error(sim.mass_matrix()[0], mujoco.mass_matrix()) < 1e-6


def test_the_command(cli, tmp_path):
    done = cli("bodies", "generate", "new", "--count", "6", "--kinds", "hexapod,biped", "--prefix", "walker")
    assert done.returncode == 0, done.stderr
    assert "6 bodies" in done.stdout
    assert sorted(path.name for path in (tmp_path / "new/assets/robots").iterdir())[0] == "walker_biped_1"
    done = cli("bodies", "generate", "new", "--count", "6")
    assert done.returncode == 2
    assert "--force" in done.stderr
    for line in (["--kinds", "snake"], ["--count", "0"], ["--prefix", "A b"], ["--seed", "-1"]):
        done = cli("bodies", "generate", "other", *line)
        assert done.returncode == 2, line
        assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_library_leaves_nothing(tmp_path, monkeypatch, error):
    written = []

    def write(path, text):
        written.append(path)
        if len(written) == 7:
            raise error
        files_of_polypod.write_text(path, text)

    monkeypatch.setattr(bodies.library, "write_text", write)
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "new", tmp_path / "empty"):
        written.clear()
        with pytest.raises((KeyboardInterrupt, _core.ConfigError)):
            bodies.generate(folder, 6)
        assert len(written) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
    monkeypatch.undo()
    # no --force is needed afterwards, and the folder has the rights of any new one
    bodies.generate(tmp_path / "empty", 6)
    (tmp_path / "other").mkdir()
    assert (tmp_path / "empty").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_library_that_is_there_stays_whole(tmp_path, monkeypatch):
    """With --force as well: nothing is replaced before all is written."""
    bodies.generate(tmp_path / "a", 6, seed=1)
    before = files(tmp_path / "a")
    monkeypatch.setattr(bodies.files, "tasks", lambda task, names: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        bodies.generate(tmp_path / "a", 6, seed=2, force=True)
    assert files(tmp_path / "a") == before
    monkeypatch.undo()
    bodies.generate(tmp_path / "a", 6, seed=2, force=True)
    bodies.generate(tmp_path / "b", 6, seed=2)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_wide_quadrupeds_reach_around_the_librarys():
    """Numbers that tell the library's joints apart lie within those of 200 drawn bodies."""
    sim = _core.VecSim("velocity_flat_legged_play", 24, threads=1)
    info = json.loads(sim.robot_info())
    robots = [robot for robot in sim.robots if info[robot]["class"] == "quadruped"]
    assert len(robots) >= 15
    for robot, numbers in bodies_coverage.outside(robots).items():
        assert not numbers, (robot, list(map(str, numbers)))


def test_numbers_outside_are_named():
    (numbers,) = bodies_coverage.outside(["unitree_go1"], count=20, wide=False).values()
    names = {number.name for number in numbers}
    # all bodies that are not wide have the same limits
    assert {"front HAA upper", "hind KFE speed"} <= names
    assert not any("position" in name for name in names), names
    assert "drawn 0.9 to 0.9" in str(next(number for number in numbers if number.name == "front HAA upper"))


def test_a_robot_is_compared_with_bodies_of_its_class():
    """The knees of Bolt bend backwards, those of drawn bipeds forwards."""
    (numbers,) = bodies_coverage.outside(["bolt"], count=4, wide=False).values()
    assert "KNEE default" in {number.name for number in numbers}


def test_bodies_that_are_not_wide_stay_those_of_the_bundled_policy(tmp_path):
    """Byte for byte: docs/train.md says which ones it was trained on."""
    kinds = ("quadruped", "quadruped", "quadruped", "quadruped8")
    made = [bodies.draw(kinds[i % 4], f"q_{kinds[i % 4]}_{i:03}", np.random.default_rng([11, i])) for i in range(8)]
    text = "".join(bodies.urdf(body) + bodies.toml(body, 11) for body in made)
    assert (
        hashlib.sha256(text.encode()).hexdigest() == "a162f164688019a7c884645b62a29add396d770d18e6cf17134283ad9fdd5278"
    )


def test_wide_bodies_stand(tmp_path, monkeypatch):
    """Joints have room about the default pose, and strong motors hold it."""
    made = bodies.generate(tmp_path / "wide", 24, seed=5, kinds=["quadruped", "quadruped8"], wide=True)
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "wide"))
    assert json.loads((tmp_path / "wide/bodies.json").read_text())["wide"] is True
    for body in made:
        for joint in body.joints:
            assert joint.lower <= joint.angle - 0.19
            assert joint.angle + 0.19 <= joint.upper
    env = polypod.make(bodies.TASK + "_play", len(made), seed=0, autoreset="disabled")
    env.reset()
    fallen = np.zeros(len(made), dtype=np.bool_)
    for _ in range(100):
        fallen |= env.step(np.zeros((len(made), env.sim.num_actions), dtype=np.float32))[2]
    assert env.state.valid.all()
    assert fallen.mean() <= 0.15, [body.name for body, fell in zip(made, fallen, strict=True) if fell]


ON_TWO_LEGS = ("unitree_h1", "unitree_g1", "booster_t1", "limx_tron1", "bolt")


def test_wide_bodies_on_two_legs_reach_around_the_librarys():
    """Cassie's tarsus and hips that turn inwards in the default pose are not drawn."""
    for robot, numbers in bodies_coverage.outside(ON_TWO_LEGS).items():
        outside = [number for number in numbers if "WRIST" not in number.name]
        assert len(outside) <= 1, (robot, list(map(str, outside)))


def test_bodies_on_two_legs_that_are_not_wide_have_one_limit_each():
    (numbers,) = bodies_coverage.outside(["unitree_h1"], count=20, wide=False).values()
    names = {number.name for number in numbers}
    assert {"HIP_YAW lower", "KNEE upper", "HIP_PITCH speed", "SHOULDER_YAW position x"} & names
    assert len(names) > 40


def _ends(sim, body):
    """Where a body touches the ground below each leg, and the tilt of its soles, rad."""
    places, turns = (each[0] for each in sim.link_pose())
    found = []
    balls = {name[0]: (link, at) for name, link, at, _ in body.feet}
    for place in "LR":
        if place in balls:
            link, at = balls[place]
            tilt, shape = 0.0, rotations.matrix(turns[sim.link_names.index(link)])
        else:
            (sole,) = (link for link in body.links if link.name == f"{place}_sole")
            link, own = sole.name, rotations.matrix(turns[sim.link_names.index(sole.name)])
            shape = own @ rotations.matrix(rotations.of_angles(*sole.turned))
            tilt = float(np.arccos(min(1.0, shape[2, 2])))
            at, shape = (
                np.array(sole.at) + rotations.matrix(rotations.of_angles(*sole.turned)) @ [0.0, 0.0, -sole.size[2] / 2],
                own,
            )
        found.append((places[sim.link_names.index(link)] + shape @ np.array(at), tilt))
    return found


def test_wide_bodies_on_two_legs_are_sound(tmp_path, monkeypatch):
    """Soles are level below the centre of mass, and joints turn as their roles state.

    They begin to fall slowly, as machines do.
    """
    count = size(40, 200)
    made = bodies.generate(tmp_path / "wide", count, seed=5, kinds=["humanoid", "biped"], wide=True)
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "wide"))
    env = polypod.make(bodies.TASK + "_play", count, seed=0, autoreset="same_step")
    env.reset()
    info = json.loads(env.sim.robot_info())
    lasted = np.full(count, 50)
    for body in made:
        assert info[body.name]["class"] == body.kind
        assert set(info[body.name]["joint_names"]) == {joint.name for joint in body.joints}
        assert min(info[body.name]["slot_signs"]) == 1.0, body.name
        assert body.links[0].mass > 0.11 * body.mass
        assert min(link.mass for link in body.links) > 0.0
        for joint in body.joints:
            assert joint.lower <= joint.angle - 0.19
            assert joint.angle + 0.19 <= joint.upper
        sim = polypod.Simulation(str(tmp_path / "wide/assets/robots" / body.name / "robot.urdf"), ground=None)
        angles = {joint.name: joint.angle for joint in body.joints}
        qpos = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *(angles[name] for name in sim.joint_names)]
        sim.set_state(np.array(qpos), np.zeros(6 + len(angles)))
        centre, ends = sim.center_of_mass()[0], _ends(sim, body)
        assert np.ptp([at[2] for at, _ in ends]) < 1e-4 * body.leg_length, body.name
        assert abs(np.mean([at[0] for at, _ in ends]) - centre[0]) < 0.05 * body.leg_length, body.name
        assert max(tilt for _, tilt in ends) < 1e-3, body.name
    for step in range(50):
        ended = env.step(np.zeros((count, env.sim.num_actions), dtype=np.float32))[2]
        lasted[ended] = np.minimum(lasted[ended], step + 1)
    assert env.state.valid.all()
    assert np.median(lasted) >= 40
    assert (lasted < 20).mean() <= 0.05, [body.name for body, steps in zip(made, lasted, strict=True) if steps < 20]


def test_wide_bodies_on_two_legs_depend_on_seed_and_number_alone(tmp_path):
    few = bodies.generate(tmp_path / "few", 4, kinds=["humanoid", "biped"], wide=True)
    assert few == bodies.generate(tmp_path / "more", 6, kinds=["humanoid", "biped"], wide=True)[:4]
