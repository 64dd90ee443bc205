"""A new robot: from a URDF to training with `polypod robot new`, without a changed source."""

import math
import os
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import tomllib
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import polypod
from common import FLAT_POLICY, ROOT, size
from polypod import _core
from polypod.evaluation import evaluate, load_policy
from polypod.new_robot import new_robot
from polypod.runs import run_dir

ROBOTS = [
    path.stem
    for path in sorted((ROOT / "configs/robots").glob("*.toml"))
    if "LF_HAA" in tomllib.loads(path.read_text())["default_pose"]
]
NEW = ["unitree_aliengo", "unitree_laikago", "unitree_b1", "unitree_a2", "unitree_as2"]
"""Robots that the bundled policy was not trained on."""
QUICK = ("--num-envs", "16", "--max-iterations", "2", "--logger", "none", "--set", "sim.episode_length_s=0.4")


def link(name, mass, size, at=(0.0, 0.0, 0.0), shape=None):
    """A link whose mass is spread over a box of `size` about `at`, m."""
    x, y, z = size
    inertia = [mass / 12 * s for s in (y * y + z * z, x * x + z * z, x * x + y * y)]
    origin = f'<origin xyz="{at[0]} {at[1]} {at[2]}"/>'
    shape = shape or f'<box size="{x} {y} {z}"/>'
    return f"""<link name="{name}">
  <inertial>{origin}<mass value="{mass}"/>
    <inertia ixx="{inertia[0]}" iyy="{inertia[1]}" izz="{inertia[2]}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision>{origin}<geometry>{shape}</geometry></collision></link>"""


def joint(name, parent, child, at, axis, limits=None):
    limit = "" if limits is None else '<limit lower="{}" upper="{}" effort="{}" velocity="{}"/>'.format(*limits)
    kind = "fixed" if axis is None else "revolute"
    axis = "" if axis is None else f'<axis xyz="{axis}"/>'
    return f"""<joint name="{name}" type="{kind}"><origin xyz="{at[0]} {at[1]} {at[2]}"/>
  <parent link="{parent}"/><child link="{child}"/>{axis}{limit}</joint>"""


def quadruped(mass=22.0, thigh=0.26, shank=0.3, length=0.6, antenna=False, effort=60.0):
    """A URDF with meaningless names, knees that bend to one side, and a front-heavy trunk."""
    parts = [link("trunk", 0.7 * mass, (length, 0.24, 0.14), at=(0.02, 0.0, 0.0))]
    for number, (x, y) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)]):
        a, b, c, foot = (f"{part}{number}" for part in ("a", "b", "c", "pad"))
        legs = 0.3 * mass / 4
        parts += [
            link(a, 0.3 * legs, (0.08, 0.08, 0.08)),
            link(b, 0.5 * legs, (0.05, 0.04, thigh), at=(0.0, 0.0, -thigh / 2)),
            link(c, 0.18 * legs, (0.03, 0.03, 0.8 * shank), at=(0.0, 0.0, -0.4 * shank)),
            link(foot, 0.02 * legs, (0.03, 0.03, 0.03), shape='<sphere radius="0.025"/>'),
            joint(f"m{number}1", "trunk", a, (x * 0.4 * length, y * 0.1, 0.0), "1 0 0", (-0.8, 0.8, effort, 20.0)),
            joint(f"m{number}2", a, b, (0.0, y * 0.07, 0.0), "0 1 0", (-1.5, 2.5, effort, 20.0)),
            joint(f"m{number}3", b, c, (0.0, 0.0, -thigh), "0 1 0", (-2.6, -0.3, 1.5 * effort, 14.0)),
            joint(f"f{number}", c, foot, (0.0, 0.0, -shank), None),
        ]
    if antenna:
        parts += [
            link("antenna", 0.2, (0.02, 0.02, 0.3), at=(0.0, 0.0, 0.15)),
            joint("wag", "trunk", "antenna", (0.0, 0.0, 0.07), "0 1 0", (0.2, 1.0, 1.0, 1.0)),
        ]
    return f'<robot name="Test Fox">{"".join(parts)}</robot>'


@pytest.fixture
def fox(tmp_path):
    file = tmp_path / "fox" / "description.urdf"
    file.parent.mkdir()
    file.write_text(quadruped(antenna=True))
    return file


def test_from_urdf_to_training(cli, tmp_path, fox):
    done = cli("robot", "new", "fox/description.urdf")
    assert done.returncode == 0, done.stderr
    assert "16 of 16 stand" in done.stdout
    assert "wag is no leg's" in done.stdout
    config = tomllib.loads((fox.parent / "test_fox.toml").read_text())
    assert config["urdf"] == "description.urdf"
    assert config["joint_roles"]["LF_HAA"] == "m01"
    assert config["joint_roles"]["RH_KFE"] == "m33"
    assert config["feet"] == {"LF": "pad0", "RF": "pad1", "LH": "pad2", "RH": "pad3"}
    assert config["locked_joints"] == {"wag": 0.2}
    assert config["actuators"]["knees"]["effort_limit"] == 90.0
    done = cli("train", *QUICK, "--robots", "fox/test_fox.toml,spot")
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("logs/rsl_rl/*/*/model_2.pt"))


def test_its_progress_is_told_part_by_part(fox, tmp_path):
    told = []
    new_robot(fox, tmp_path / "fox.toml", progress=lambda *part: told.append(part))
    assert told[:3] == [("try 1: drafts", 0, 1), ("try 1: drafts", 1, 1), ("try 1: stands", 1, 200)]
    assert told[-1][1:] == (200, 200)
    tries = sorted({part for part, _, _ in told})
    assert all(sum(name == part for name, _, _ in told) in (2, 200) for part in tries), tries


def test_by_name_with_tasks_of_its_own(cli, tmp_path, fox, monkeypatch):
    done = cli("robot", "new", str(fox), "--out", "mine/configs/robots/swift_fox.toml")
    assert done.returncode == 0, done.stderr
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "mine"))
    assert "Velocity-Flat-Swift-Fox-v0" in cli("list", "tasks").stdout
    done = cli("train", *QUICK, "--task", "Velocity-Flat-Swift-Fox-v0")
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_2.pt")
    done = cli("eval", "--checkpoint", str(checkpoint), "--steps", "20", "--num-envs", "4")
    assert done.returncode == 0, done.stderr


def test_a_file_that_is_there_is_kept(cli, fox):
    kept = fox.with_name("test_fox.toml")
    kept.write_text("mine")
    done = cli("robot", "new", str(fox))
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert kept.read_text() == "mine"
    assert cli("robot", "new", str(fox), "--force").returncode == 0
    assert kept.read_text() != "mine"


def test_what_has_no_legs_is_refused(cli, tmp_path):
    done = cli("robot", "new", str(ROOT / "tests/data/urdf/mixed.urdf"), "--out", str(tmp_path / "cart.toml"))
    assert done.returncode == 2
    assert "0 legs were found instead of 2, 4 or 6" in done.stderr
    assert not (tmp_path / "cart.toml").exists()


def test_a_name_that_is_not_the_files(fox):
    with pytest.raises(_core.ConfigError, match=r"the file of a robot `wolf` is wolf\.toml"):
        new_robot(fox, fox.with_name("fox.toml"), name="wolf")


def test_missing_limits_are_told(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(quadruped().replace('effort="60.0"', 'effort="0"'))
    (note,) = (note for note in new_robot(file).notes if "no effort limit for m" in note)
    assert all(f"m{leg}{number}" in note for leg in range(4) for number in (1, 2))
    assert "m03" not in note


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_urdfs_that_come_along_make_robots_that_stand(tmp_path, robot):
    made = new_robot(ROOT / "assets/robots" / robot / "robot.urdf", tmp_path / "draft.toml")
    assert made.standing.holds
    assert made.gain_factor == 1.0


def test_drafts_stand_in_a_pose_that_the_bundled_policy_knows(tmp_path):
    """As drafted from the URDF alone; a robot that stands still is off by 0.9 m/s."""
    made = [new_robot(ROOT / f"assets/robots/{robot}/robot.urdf", tmp_path / f"draft_{robot}.toml") for robot in NEW]
    policy = load_policy(run_dir.load_checkpoint(FLAT_POLICY), run_dir.read_manifest(FLAT_POLICY)["policy"])
    grid = (5, 5, 3)
    count = len(made) * math.prod(grid)
    result = evaluate(
        policy, "velocity_flat_universal", robots=[str(new.path) for new in made], num_envs=count, grid=grid
    )
    for name, figures in result.robots.items():
        assert figures.error_vel_xy <= 0.15, name
        assert figures.fall_rate <= 0.02, name


def test_what_lies_on_its_belly_does_not_stand(cli, tmp_path):
    """No trunk shape can touch the ground, so nothing ends an episode; its motors are weak."""
    text = quadruped(effort=3.0)
    begin = text.index("<collision>")
    file = tmp_path / "robot.urdf"
    file.write_text(text[:begin] + text[text.index("</collision>") + len("</collision>") :])
    done = cli("robot", "new", str(file), "--name", "flat")
    assert "lies on its belly or its knees" in done.stdout
    assert "flat does not hold its default pose" in done.stderr


def test_a_missing_mesh_is_named_where_it_is_the_cause(cli, tmp_path):
    mesh = '<mesh filename="package://fox/pad.stl"/>'
    text = quadruped().replace('<sphere radius="0.025"/>', mesh)
    shank = text.index('<link name="c0">')
    end = text.index("</link>", shank)
    text = text[:shank] + text[shank:end].replace('<box size="0.03 0.03 0.24"/>', mesh) + text[end:]
    # with no inertia whose box could take its place
    pad = text.index('<link name="pad0">')
    text = text[:pad] + '<link name="pad0"/>' + text[text.index("</link>", pad) + len("</link>") :]
    shank = text.index('<link name="c0">')
    mass = text.index('<mass value="', shank)
    text = text[:mass] + '<mass value="0.0005"/>' + text[text.index("/>", mass) + 2 :]
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    done = cli("robot", "new", str(file))
    assert done.returncode == 2
    assert "leg LF has no collision shape" in done.stderr
    assert (
        '4 collision meshes were left out: link "c0", <collision>: mesh "package://fox/pad.stl" is not found'
        in done.stderr
    )
    assert 'name the directory of "fox" in package_dirs' in done.stderr


def test_a_foot_may_be_named(cli, fox):
    done = cli("robot", "new", str(fox), "--foot", "LF=c0")
    assert done.returncode == 0, done.stderr
    assert tomllib.loads(fox.with_name("test_fox.toml").read_text())["feet"]["LF"] == "c0"
    done = cli("robot", "new", str(fox), "--force", "--foot", "LF=pad")
    assert done.returncode == 2
    assert "feet.LF" in done.stderr


def fingers(follower):
    """A gripper on the trunk whose second finger follows the first."""
    slide = '<joint name="{0}" type="prismatic"><origin xyz="0.3 {1} 0"/><parent link="trunk"/><child link="{0}_link"/>'
    limit = '<axis xyz="0 1 0"/><limit lower="0.01" upper="0.04" effort="5" velocity="0.1"/>{0}</joint>'
    return "".join(
        link(f"{name}_link", 0.05, (0.05, 0.01, 0.02)) + slide.format(name, y) + limit.format(mimic)
        for name, y, mimic in (("finger_1", 0.03, ""), ("finger_2", -0.03, follower))
    )


def test_fingers_that_mimic_each_other_are_held(cli, tmp_path):
    file = tmp_path / "robot.urdf"
    text = quadruped().replace("</robot>", fingers('<mimic joint="finger_1" multiplier="2"/>') + "</robot>")
    file.write_text(text)
    done = cli("check", str(file))
    assert done.returncode == 0, done.stderr
    assert (
        'joint "finger_2": it mimics "finger_1"; coupled joints are not modelled, so it is held at 0.02' in done.stdout
    )
    done = cli("robot", "new", str(file))
    assert done.returncode == 0, done.stderr
    assert "16 of 16 stand" in done.stdout
    assert "finger_2 is coupled to another by <mimic>" in done.stdout
    config = tomllib.loads((tmp_path / "test_fox.toml").read_text())
    assert config["locked_joints"] == {"finger_1": 0.01, "finger_2": 0.02}
    with pytest.warns(UserWarning, match="it mimics"):
        sim = polypod.Simulation(file)
    assert "finger_1" in sim.joint_names
    assert "finger_2" not in sim.joint_names
    # or where the caller wants it
    sim = polypod.Simulation(file, locked_joints={"finger_1": 0.03, "finger_2": 0.03})
    assert sim.num_joints == 12
    assert sim.warnings == []
    done = cli("robot", "new", str(file), "--force", "--lock", "finger_2=0.03")
    assert tomllib.loads((tmp_path / "test_fox.toml").read_text())["locked_joints"]["finger_2"] == 0.03
    assert cli("check", str(file), "--lock", "finger_2=0.03").stdout.count("mimics") == 0
    done = cli("check", str(file), "--lock", "finger_2=wide")
    assert done.returncode == 2
    assert "write rad or m" in done.stderr


def test_a_leg_joint_that_mimics_is_named_where_it_is_the_cause(cli, tmp_path):
    file = tmp_path / "robot.urdf"
    at = '<limit lower="-2.6" upper="-0.3" effort="90.0" velocity="14.0"/>'
    text = quadruped()
    assert text.count(at) == 4
    file.write_text(text.replace(at, at + '<mimic joint="m02"/>'))
    done = cli("robot", "new", str(file))
    assert done.returncode == 2
    assert 'joint "m03": it mimics "m02"' in done.stderr
    assert "remove <mimic> to let it move by itself" in done.stderr
    assert cli("check", str(file)).returncode == 0


ROLES = {
    f"{leg}_{role}": f"m{number}{joint}"
    for number, leg in enumerate(("LF", "RF", "LH", "RH"))
    for joint, role in enumerate(("HAA", "HFE", "KFE"), start=1)
}
"""Joints of `quadruped` by their slots."""


def with_upward_legs(count):
    """`quadruped` with its first legs pointing upwards at zero."""
    text = quadruped()
    for number in range(count):
        place = text.index(f'<joint name="m{number}2"')
        end = text.index('xyz="0.0 ', place)
        text = text[:end] + 'rpy="0 3.0 0" ' + text[end:]
    return text


def test_roles_may_be_named(cli, tmp_path):
    """The errors' remedy works: three legs that point upwards at zero are no legs by geometry."""
    file = tmp_path / "robot.urdf"
    file.write_text(with_upward_legs(3))
    done = cli("robot", "new", str(file))
    assert done.returncode == 2
    assert "--role SLOT=JOINT of robot new" in done.stderr
    roles = [f"{slot}={joint}" for slot, joint in ROLES.items()]
    done = cli("robot", "new", str(file), *(word for role in roles for word in ("--role", role)))
    assert done.returncode == 0, done.stderr
    config = tomllib.loads((tmp_path / "test_fox.toml").read_text())
    assert {f"{slot}={joint}" for slot, joint in config["joint_roles"].items()} == set(roles)


def test_roles_that_are_named_keep_the_frame_of_legs_that_point_upwards(tmp_path):
    """Stretched legs above the body are those of a base with z down, unless somebody knows."""
    file = tmp_path / "robot.urdf"
    file.write_text(with_upward_legs(4))
    made = new_robot(file, tmp_path / "test_fox.toml")
    assert [note for note in made.notes if "so -z is taken for up" in note]
    made = new_robot(file, tmp_path / "test_fox.toml", force=True, joint_roles=ROLES)
    assert tomllib.loads(made.path.read_text())["urdf"] == "robot.urdf"
    assert not [note for note in made.notes if "is taken for up" in note]


@pytest.mark.skipif(os.name == "nt", reason="links ask for rights there")
def test_links_in_a_circle_are_no_bug(cli, tmp_path, fox):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for line in (
        ["check", "loop"],
        ["robot", "new", "loop"],
        ["robot", "new", "loop/robot.urdf"],
        ["robot", "new", str(fox), "--out", "loop/test_fox.toml"],
        ["robot", "new", str(fox), "--package-dir", "a=loop", "--force"],
    ):
        done = cli(*line)
        assert "bug" not in done.stderr, done.stderr
        assert done.returncode == (0 if "a=loop" in line else 2), (line, done.stderr)


def test_meshes_are_summed_up(cli, tmp_path):
    text = quadruped().replace('<sphere radius="0.025"/>', f'<mesh filename="{tmp_path}/pad.obj"/>')
    corners = [(x, y, z) for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02)]
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "pad.obj").write_text(vertices + "".join(f"f {i} {i} {i}\n" for i in range(1, 9)))
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    done = cli("robot", "new", str(file))
    assert "4 meshes are taken as convex hulls" in done.stdout
    assert f"`polypod check {file}` lists them" in done.stdout
    assert "taken as the convex hull of" not in done.stdout + done.stderr
    assert cli("check", str(file)).stdout.count("is taken as the convex hull of 8 of its 8 vertices") == 4
    with pytest.warns(UserWarning, match="4 meshes are taken") as caught:
        polypod.Simulation(file)
    assert [str(warning.message).count("4 meshes are taken") for warning in caught] == [1]


def test_changes_of_robots_may_be_set(cli, fox):
    """Robots of the library and robots by path, in a task that changes none itself."""
    assert cli("robot", "new", str(fox)).returncode == 0
    arguments = {"robots": [str(fox.with_name("test_fox.toml")), "spot"], "seed": 0}
    changes = ["robot_overrides.test_fox.action_scale=0.5", "robot_overrides.spot.default_pose.LF_HAA=0.0"]
    env = polypod.make("velocity_flat", 2, overrides=changes, **arguments)
    config = tomllib.loads(env.sim.resolved_config())["robots"]
    assert config["test_fox"]["action_scale"] == 0.5
    assert config["spot"]["default_pose"]["LF_HAA"] == 0.0
    with pytest.raises(_core.ConfigError, match="there is no robot `test_wolf`"):
        polypod.make("velocity_flat", 2, overrides=["robot_overrides.test_wolf.action_scale=0.5"], **arguments)
    with pytest.raises(_core.ConfigError, match="did you mean `action_scale`"):
        polypod.make("velocity_flat", 2, overrides=["robot_overrides.spot.action_scal=0.5"], **arguments)


def test_an_unknown_robot_says_where_own_ones_belong():
    with pytest.raises(_core.UnknownNameError, match=r"did you mean `spot`.*the path of its \.toml.*POLYPOD_PATH"):
        polypod.make("velocity_flat", 1, robots=["spott"])


@settings(
    max_examples=size(12, 100),
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    mass=st.floats(4.0, 90.0),
    thigh=st.floats(0.12, 0.4),
    shank=st.floats(0.12, 0.4),
    length=st.floats(0.35, 0.9),
)
def test_quadrupeds_of_any_size_stand(tmp_path, mass, thigh, shank, length):
    file = tmp_path / "robot.urdf"
    file.write_text(quadruped(mass, thigh, shank, length, effort=400.0))
    made = new_robot(file, force=True)
    assert made.standing.holds
    upright = 0.72 * (thigh + shank) + 0.025
    # joints that give way by 0.2 rad let a leg this bent down by a fifth
    assert 0.8 * upright < made.standing.height < 1.02 * upright
    env = polypod.make("velocity_flat", 4, robots=[str(made.path)], seed=0)
    env.reset()
    for _ in range(20):
        observations = env.step(np.ones((4, 12), dtype=np.float32))[0]
    assert np.isfinite(observations).all()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"lower": 57.3, "upper": 57.3}, 'joint "[^"]*", <limit>: .* it looks like degrees; write radians'),
        (
            {"effort": 1e-6},
            r"a config that follows from it is refused: actuators\..*below 0.001 N m; a URDF has metres",
        ),
    ],
)
def test_a_refused_draft_is_the_urdfs_fault_and_does_not_stay(tmp_path, changes, problem):
    """Nobody wrote the config; the line names the URDF and what to look at there."""
    tree = ElementTree.parse(ROOT / "assets/robots/berkeley_humanoid/robot.urdf")
    for limit in tree.iter("limit"):
        for key, factor in changes.items():
            limit.set(key, repr(factor * float(limit.get(key))))
    tree.write(tmp_path / "mine.urdf")
    with pytest.raises(_core.RobotError, match=rf"^{re.escape(str(tmp_path / 'mine.urdf'))}: {problem}"):
        new_robot(tmp_path / "mine.urdf", tmp_path / "mine.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.urdf"]
