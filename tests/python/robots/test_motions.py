"""Motions are read or refused, drawn on any humanoid, and retargeted with losses said."""

import numpy as np
import pytest

from polypod import _core, rotations
from polypod.cli import main
from polypod.motions import balance, key_poses, library, motion, retarget
from polypod.motions.body import body_of
from polypod.motions.motion import Motion, velocities

HUMANOIDS = ["unitree_g1", "unitree_h1", "booster_t1"]


def small(**changes):
    """A motion of three frames, and changes of its arrays."""
    body = body_of("unitree_g1")
    arrays = {
        "fps": np.float64(50.0),
        "robot": np.array("unitree_g1"),
        "joint_names": np.array(body.joints),
        "joint_pos": np.tile(body.default, (3, 1)),
        "base_pos": np.tile([0.0, 0.0, 0.757], (3, 1)),
        "base_quat": np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
    }
    return {name: array for name, array in {**arrays, **changes}.items() if array is not None}


def saved(tmp_path, **changes):
    path = tmp_path / "small.npz"
    np.savez(path, **small(**changes))
    return path


def test_a_motion_is_read_as_it_was_written(tmp_path):
    first = library.clip_of("squat", "unitree_g1")
    motion.save(first, tmp_path / "squat.npz")
    again = motion.read(tmp_path / "squat.npz")
    assert again.joint_names == first.joint_names
    assert again.robot == "unitree_g1"
    assert again.fps == first.fps
    for name in ("joint_pos", "base_pos", "base_quat"):
        np.testing.assert_allclose(getattr(again, name), getattr(first, name), atol=1e-6)


@pytest.mark.parametrize(
    ("array", "value", "message"),
    [
        ("joint_pos", None, "joint_pos: this array is missing"),
        ("joint_pos", np.zeros((3, 28)), r"joint_pos: shape \(3, 28\); write \(3, 29\)"),
        ("base_pos", np.full((3, 3), np.nan), r"base_pos: the number at \[0, 0\] is not finite"),
        ("base_quat", np.full((3, 4), 0.6), "base_quat: the quaternion of frame 0 has length 1.2; write unit"),
        ("fps", np.float64(0.0), "fps: 0.0; write one frame rate"),
        ("joint_names", np.array(["a", "a"]), "joint_names: 2 names, of which 1 differ"),
        ("joint_names", np.array([{}, {}], dtype=object), "objects of Python are refused"),
        ("body_pos_w", np.zeros(3), "body_pos_w: no array of a motion"),
    ],
)
def test_a_broken_file_is_refused_by_the_name_of_its_array(tmp_path, array, value, message):
    path = saved(tmp_path, **{array: value})
    with pytest.raises(_core.ConfigError, match=message) as error:
        motion.read(path)
    assert str(path) in str(error.value)


def test_joints_that_the_robot_lacks_and_links_elsewhere_are_refused(tmp_path):
    names = small()["joint_names"].copy()
    names[0] = "tail_joint"
    with pytest.raises(_core.ConfigError, match="joint_names: unitree_g1 has no joint 'tail_joint'"):
        library.clip_of(str(saved(tmp_path, joint_names=names)), "unitree_g1")
    links = {"link_names": np.array(["torso_link"]), "link_quat": np.tile([1.0, 0.0, 0.0, 0.0], (3, 1, 1))}
    with pytest.raises(_core.ConfigError, match=r"link_pos: torso_link is .* m from where the joints"):
        library.read(saved(tmp_path, link_pos=np.zeros((3, 1, 3)), **links))


def test_a_csv_of_frames_is_imported_in_the_named_order(tmp_path, capsys):
    body = body_of("unitree_g1")
    row = ["0.1", "0", "0.76", "0", "0", "1", "0", *(str(value) for value in body.default)]
    table = tmp_path / "walk.csv"
    table.write_text("\n".join([",".join(row)] * 3))
    with pytest.raises(_core.ConfigError, match="the first line names no columns"):
        motion.read_csv(table, "unitree_g1", 30.0)
    read = motion.read_csv(table, "unitree_g1", 30.0, body.joints)
    # x y z w in the file: half a turn about z
    np.testing.assert_allclose(read.base_quat[0], [0.0, 0.0, 0.0, 1.0])
    named = tmp_path / "named.csv"
    named.write_text(",".join([*motion.BASE_COLUMNS, *body.joints]) + "\n" + table.read_text())
    np.testing.assert_array_equal(motion.read_csv(named, "unitree_g1", 30.0).joint_pos, read.joint_pos)
    line = ["motions", "import", str(table), "--robot", "unitree_g1", "--joints", "robot", "--ground"]
    assert main([*line, "--out", str(tmp_path / "walk.npz")]) == 0
    assert "feet stand on the ground" in capsys.readouterr().out
    np.testing.assert_allclose(body.feet_gap(body.qpos(motion.read(tmp_path / "walk.npz"))).min(), 0.0, atol=1e-4)


@pytest.mark.parametrize("robot", HUMANOIDS)
@pytest.mark.parametrize("name", ["walk", "turn"])
def test_drawn_feet_stand_on_the_ground_and_do_not_slip(name, robot):
    body = body_of(robot)
    drawn = library.clip_of(name, robot)
    qpos = body.qpos(drawn)
    gap = body.feet_gap(qpos)
    # H1 has no ankle roll: its soles tilt by what the base sways
    assert gap.min() > -0.002
    assert gap.min(axis=1).max() < 0.001
    position, _ = body.kinematics(qpos)
    feet = position[:, [body.links.index(body.foot(side)) for side in range(2)]]
    stands = gap < 0.001
    moved = np.linalg.norm(np.diff(feet[:, :, :2], axis=0), axis=-1) * drawn.fps
    assert moved[stands[1:] & stands[:-1]].max() < 0.01
    # each foot is lifted and goes somewhere
    assert gap.max(axis=0).min() > 0.02
    assert np.linalg.norm(feet[-1] - feet[0], axis=-1).min() > 0.05


@pytest.mark.parametrize("name", ["squat", "wave", "jump"])
def test_drawings_are_within_limits_on_every_humanoid(name):
    for robot in HUMANOIDS:
        body = body_of(robot)
        drawn = library.clip_of(name, robot)
        assert (drawn.joint_pos >= body.lower - 1e-9).all()
        assert (drawn.joint_pos <= body.upper + 1e-9).all()
        flies = body.feet_gap(body.qpos(drawn)).min(axis=1).max()
        assert bool(flies > 0.03) is (name == "jump")
        linear, _, _ = velocities(drawn)
        # a throw falls with gravity, and nothing in these motions is as fast as a throw of a metre
        assert np.abs(linear).max() < 2.0
        if name == "squat":
            assert np.ptp(drawn.base_pos[:, 2]) == pytest.approx(0.2 * body.leg, rel=0.05)


def test_velocities_are_those_of_the_frames():
    time = np.arange(101) / 50.0
    turning = Motion(
        name="turning",
        robot="",
        fps=50.0,
        joint_names=("a",),
        joint_pos=np.sin(time)[:, np.newaxis],
        base_pos=np.stack([2.0 * time, 0.0 * time, 0.0 * time], axis=1),
        base_quat=rotations.of_yaw(1.5 * time),
    )
    linear, angular, joints = velocities(turning)
    np.testing.assert_allclose(linear, np.tile([2.0, 0.0, 0.0], (101, 1)), atol=1e-9)
    np.testing.assert_allclose(angular, np.tile([0.0, 0.0, 1.5], (101, 1)), atol=1e-9)
    np.testing.assert_allclose(joints[1:-1, 0], np.cos(time)[1:-1], atol=1e-3)
    half = turning.resampled(25.0)
    assert half.frames == 51
    np.testing.assert_allclose(half.base_quat, turning.base_quat[::2], atol=1e-9)


def test_retargeting_says_what_is_lost_and_keeps_feet_still():
    g1, h1 = body_of("unitree_g1"), body_of("unitree_h1")
    walk = library.clip_of("walk", "unitree_g1")
    made = retarget.retarget(walk, g1, h1)
    scale = h1.leg / g1.leg
    way, whole = (np.subtract(*clip.base_pos[[-1, 0], 0]) for clip in (made, walk))
    np.testing.assert_allclose(way, scale * whole, rtol=1e-6)
    notes = "\n".join(made.notes)
    assert f"base and feet go {scale:.2f} times as far" in notes
    assert "unitree_h1 has no L_ANKLE_ROLL, which turns by up to" in notes
    gap = h1.feet_gap(h1.qpos(made))
    assert gap.min(axis=1).max() < 0.002
    # a joint that goes further than the target's
    wide = walk.joint_pos.copy()
    wide[:, g1.joints.index("left_elbow_joint")] = -1.0
    bent = library.clip_of("wave", "booster_t1")
    t1 = body_of("booster_t1")
    assert retarget.retarget(bent, t1, t1).notes == ()
    turned = bent.joint_pos.copy()
    turned[:, t1.joints.index("Waist")] = 1.5
    back = retarget.retarget(Motion(**{**vars(bent), "joint_pos": turned}), t1, h1)
    assert not any("torso_joint stops" in note for note in back.notes)
    turned[:, t1.joints.index("Left_Shoulder_Pitch")] = -3.3
    back = retarget.retarget(Motion(**{**vars(bent), "joint_pos": turned}), t1, h1)
    (note,) = [note for note in back.notes if "left_shoulder_pitch_joint" in note]
    assert note == "left_shoulder_pitch_joint stops at its limit, up to 20 deg short"


def test_bad_lines_name_the_motion_and_what_there_is(capsys):
    assert main(["motions", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == key_poses.names()
    for line, message in [
        (["show"], "needs a motion or a file after it"),
        (["show", "dance"], "cannot read the motion dance: No such file or directory; there are jump, squat"),
        (["show", "squat", "--robot", "spot"], "spot has no joint of the role L_HIP_PITCH"),
        (["retarget", "squat", "--out", "x.npz"], "--robot is missing"),
        (["draw", "squat"], "--out is missing"),
        (["draw", "squat", "--episodes", "3"], "--episodes belongs to polypod motions eval"),
        (["draw", "squat", "--out", "x.csv"], "x.csv: a motion is written as .npz"),
    ]:
        assert main(["motions", *line]) == 2
        assert message in capsys.readouterr().err


def test_a_drawing_of_ones_own_is_checked(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('title = "mine"\nduration = 1.0\n[[pose]]\ntime = 0.5\nbase = { height = 1.0 }\n')
    with pytest.raises(_core.ConfigError, match=r"pose.*unknown field `height`"):
        key_poses.read(str(path))
    path.write_text('title = "mine"\nduration = 1.0\n[[pose]]\ntime = 0.5\nbase = { up = 0.9 }\n')
    with pytest.raises(_core.ConfigError, match=r"the foot . of unitree_g1 misses its place by"):
        key_poses.draw(str(path), body_of("unitree_g1"))


@pytest.mark.parametrize("robot", ["unitree_g1", "unitree_h1", "booster_t1"])
@pytest.mark.parametrize("name", ["walk", "turn"])
def test_steps_press_on_the_foot_that_stands(name, robot):
    """The ground's force acts within 6 mm of where it must, by the whole body's dynamics."""
    body = body_of(robot)
    motion = key_poses.draw(name, body)
    steps = key_poses.read(name).step
    times = np.arange(motion.frames) / motion.fps
    feet, yaw = key_poses._feet(steps, body, times)
    spans = [[(step.start, step.start + step.duration) for step in steps if step.foot == foot] for foot in "LR"]
    loads = balance.loads(spans, times)
    points = balance.zero_moment_points(body, motion)
    assert np.abs(points - balance.wanted(body, feet, yaw, loads))[1:-1].max() < 0.006
    # single support: within 3.5 cm of the line ahead of the foot that stands
    for side in range(2):
        alone = loads[:, side] > 1.0 - 1e-9
        assert alone.mean() > 0.2
        away = points[alone] - feet[alone, side, :2]
        left = np.stack([-np.sin(yaw[alone, side]), np.cos(yaw[alone, side])], axis=-1)
        assert np.abs((away * left).sum(axis=1)).max() < 0.035


@pytest.mark.parametrize("robot", HUMANOIDS)
def test_ankles_bear_motions_on_one_foot(robot):
    """H1's default pose takes 0.87 of an ankle's limit, which leaves nothing to balance with."""
    body, source = body_of(robot), body_of("unitree_g1")
    drawn = [library.clip_of(name, robot) for name in ("wave", "turn", "walk")]
    sim = _core.Simulation(robot, 1, threads=1)
    ankle = int(body.joint_of_slot[body.slots.index("L_ANKLE_PITCH")])
    for clip in [*drawn, retarget.retarget(library.clip_of("squat", "unitree_g1"), source, body)]:
        qpos = body.qpos(clip)[:1]
        sim.set_state(qpos=qpos)
        position, _ = body.kinematics(qpos)
        feet = position[0, [body.links.index(body.foot(side)) for side in range(2)], 0]
        moment = abs(float(sim.center_of_mass()[0, 0] - feet.mean())) * sim.total_mass * 9.81
        assert moment < 0.45 * sim.effort_limit[ankle], clip.name


def test_a_pendulum_sways_as_its_zero_moment_point_asks():
    times = np.arange(301) / 50.0
    error = 0.05 * np.sin(2.0 * np.pi * times / 6.0)[:, np.newaxis] * np.array([1.0, -2.0])
    moved = balance.sway(error, 0.7, 50.0, 9.81)
    # c = error / (1 + h / g w^2) solves c - h / g c'' = error
    np.testing.assert_allclose(moved, error / (1.0 + 0.7 / 9.81 * (2.0 * np.pi / 6.0) ** 2), atol=1e-4)
    assert not moved[[0, -1]].any()


def test_the_weight_moves_before_the_first_step_and_after_the_last_one():
    times = np.arange(0.0, 4.01, 0.1)
    load = balance.loads([[(1.0, 1.5)], [(1.8, 2.3)]], times)
    np.testing.assert_allclose(load.sum(axis=1), 1.0)
    at = {time: load[round(time * 10), 0] for time in (0.0, 0.5, 0.8, 1.0, 1.4, 1.6, 1.8, 2.3, 2.5, 2.8, 4.0)}
    wanted = {0.0: 0.5, 0.5: 0.5, 0.8: 0.2, 1.0: 0.0, 1.4: 0.0, 1.6: 1 / 3, 1.8: 1.0, 2.3: 1.0, 2.5: 0.8, 2.8: 0.5}
    for time, share in wanted.items():
        assert at[time] == pytest.approx(share, abs=1e-6), time
