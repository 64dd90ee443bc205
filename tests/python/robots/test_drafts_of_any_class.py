"""`polypod robot new` drafts bodies of every class from the URDF alone.

Drafts load, and stand or say why not.
"""

import json
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import tomllib
from test_new_robot import joint, link, quadruped

import polypod
from common import ROOT
from polypod import _core, base_frames, bodies, massless_links, simulated
from polypod.new_robot import new_robot

ON_SOLES = ["unitree_h1", "unitree_g1", "booster_t1", "berkeley_humanoid"]
STANDING = [*ON_SOLES, "phantomx", "box_quadruped"]
ON_POINTS = ["limx_tron1", "bolt"]


def urdf(robot):
    return ROOT / "assets/robots" / robot / "robot.urdf"


def is_usable(made):
    """It loads, acts and observes."""
    assert "leg: " in _core.check(made.path.parent / tomllib.loads(made.path.read_text())["urdf"], {})
    env = polypod.make("velocity_flat_legged", 2, robots=[str(made.path)], seed=0)
    env.reset()
    for _ in range(10):
        observations = env.step(np.full((2, env.sim.num_actions), 0.1, dtype=np.float32))[0]
    assert np.isfinite(observations).all()
    return env


@pytest.mark.parametrize("robot", STANDING)
def test_a_draft_stands(tmp_path, robot):
    """On its gains, or on two soles on stiff ones: makers of those let a policy balance."""
    made = new_robot(urdf(robot), tmp_path / f"draft_{robot}.toml")
    assert made.pose_holds, made
    if robot in ON_SOLES:
        assert not made.standing.holds
        assert made.needs_policy.endswith("as it leans: a policy balances it")
    else:
        assert made.standing.holds
        assert made.needs_policy is None
    env = is_usable(made)
    (drafted,) = json.loads(env.sim.robot_info()).values()
    (known,) = json.loads(polypod.make("velocity_flat_legged", 1, robots=[robot], seed=0).sim.robot_info()).values()
    assert (drafted["slots"], drafted["class"]) == (known["slots"], known["class"])
    # the height of the pose is about that of the published one
    assert 0.85 < drafted["base_height"] / known["base_height"] < 1.2


@pytest.mark.parametrize("robot", ON_POINTS)
def test_a_biped_without_ankles_needs_a_policy(cli, tmp_path, robot):
    made = new_robot(urdf(robot), tmp_path / f"draft_{robot}.toml")
    assert not made.standing.holds
    assert made.needs_policy == "it has two feet and no ankles: a policy steps to balance it"
    assert made.gain_factor == 1.0
    assert tomllib.loads(made.path.read_text())["reward_set"] in ("point_feet", "limx")
    is_usable(made)
    done = cli("robot", "new", str(urdf(robot)), "--out", str(made.path), "--force")
    assert "a policy steps to balance it" in done.stdout
    assert "--train-config specialist" in done.stdout
    assert "belly" not in done.stdout + done.stderr


@pytest.mark.parametrize("kind", ["quadruped8", "biped", "humanoid", "hexapod"])
def test_a_body_of_no_library_is_drafted(tmp_path, kind):
    """A generated one, of which only the URDF is left."""
    file = tmp_path / "body.urdf"
    file.write_text(bodies.urdf(bodies.draw(kind, "body", np.random.default_rng(7))))
    made = new_robot(file, tmp_path / "draft.toml")
    assert made.standing.holds or made.needs_policy is not None, made
    is_usable(made)


def test_soles_are_flat_and_below_the_centre_of_mass(tmp_path):
    """T1's arms are stretched out at zero joint positions; in the draft they hang."""
    made = new_robot(urdf("booster_t1"), tmp_path / "draft.toml")
    pose = tomllib.loads(made.path.read_text())["default_pose"]
    for side, sign in (("L", -1.0), ("R", 1.0)):
        assert sign * pose[f"{side}_SHOULDER_ROLL"] > 1.2
        assert pose[f"{side}_HIP_PITCH"] + pose[f"{side}_KNEE"] + pose[f"{side}_ANKLE_PITCH"] == pytest.approx(
            0.0, abs=5e-3
        )
        assert pose[f"{side}_KNEE"] > 0.3


def folded(thigh, shank, hip_axis, hip_limits):
    """A quadruped whose feet lie at its hips at zero: thighs and shanks point to and fro."""
    length, effort = 0.22, 60.0
    parts = [link("trunk", 9.0, (0.5, 0.22, 0.1))]
    for number, (x, y) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)]):
        along = [0.5 * length * part for part in thigh]
        back = [0.5 * length * part for part in shank]
        boxes = [tuple(0.03 + 0.9 * length * abs(part) for part in parts) for parts in (thigh, shank)]
        parts += [
            link(f"a{number}", 0.3, (0.06, 0.06, 0.06)),
            link(f"b{number}", 0.4, boxes[0], at=along),
            link(f"c{number}", 0.1, boxes[1], at=back),
            link(f"pad{number}", 0.02, (0.02, 0.02, 0.02), shape='<sphere radius="0.02"/>'),
            joint(f"m{number}1", "trunk", f"a{number}", (x * 0.22, y * 0.07, 0.0), "1 0 0", (-0.7, 0.7, effort, 20.0)),
            joint(f"m{number}2", f"a{number}", f"b{number}", (0, y * 0.06, 0), hip_axis, (*hip_limits, effort, 20.0)),
            joint(
                f"m{number}3",
                f"b{number}",
                f"c{number}",
                [2 * part for part in along],
                "0 1 0" if hip_axis == "0 -1 0" else "0 -1 0",
                (0.0, 3.1, effort, 20.0),
            ),
            joint(f"f{number}", f"c{number}", f"pad{number}", [2 * part for part in back], None),
        ]
    return f'<robot name="folded">{"".join(parts)}</robot>'


@pytest.mark.parametrize(
    "geometry",
    [
        ((-1, 0, 0), (1, 0, 0), "0 -1 0", (-0.5, 3.1)),
        ((1, 0, 0), (-1, 0, 0), "0 1 0", (-0.5, 3.1)),
        ((0, 0, 1), (0, 0, -1), "0 1 0", (-3.1, 3.1)),
    ],
    ids=["to_the_rear", "to_the_front", "upwards"],
)
def test_legs_that_are_folded_at_zero_stand(tmp_path, geometry):
    file = tmp_path / "folded.urdf"
    file.write_text(folded(*geometry))
    made = new_robot(file, tmp_path / "draft.toml")
    assert (made.kind, made.is_quadruped) == ("quadruped", True)
    assert made.standing.holds, made
    roles = tomllib.loads(made.path.read_text())["joint_roles"]
    assert {corner: roles[f"{corner}_KFE"] for corner in ("LF", "RF", "LH", "RH")} == {
        "LF": "m03",
        "RF": "m13",
        "LH": "m23",
        "RH": "m33",
    }
    is_usable(made)


def moved_frame(text, height):
    """The same robot, its base frame lower by `height`, m."""
    root = ET.fromstring(text)
    moving = {joint.find("child").get("link") for joint in root.findall("joint")}
    (base,) = (link for link in root.findall("link") if link.get("name") not in moving)
    elements = [*base.findall("inertial"), *base.findall("collision"), *base.findall("visual")]
    elements += [joint for joint in root.findall("joint") if joint.find("parent").get("link") == base.get("name")]
    for element in elements:
        origin = element.find("origin")
        if origin is None:
            origin = ET.SubElement(element, "origin", xyz="0 0 0")
        x, y, z = (float(number) for number in origin.get("xyz").split())
        origin.set("xyz", f"{x} {y} {z + height}")
    return ET.tostring(root, encoding="unicode")


@pytest.mark.parametrize(("kind", "height"), [("biped", 0.8), ("biped", 0.6), ("humanoid", 1.2), ("quadruped8", 0.7)])
def test_a_base_frame_below_the_soles_ends_no_episode(tmp_path, kind, height):
    """An episode ends when the robot has sunk, wherever its frame is."""
    text = bodies.urdf(bodies.draw(kind, "body", np.random.default_rng(7)))
    stood = []
    for name, own in (("as_drawn", text), ("below", moved_frame(text, height))):
        file = tmp_path / f"{name}.urdf"
        file.write_text(own)
        made = new_robot(file, tmp_path / f"draft_{name}.toml")
        stood.append((made.standing.holds, made.standing.falls, made.needs_policy))
        env = polypod.make("velocity_flat_legged", 4, robots=[str(made.path)], seed=0)
        env.reset()
        for _ in range(5):
            ended = env.step(np.zeros((4, env.sim.num_actions), dtype=np.float32))[2]
            assert not ended.any()
    (holds, falls, reason), (holds_below, falls_below, reason_below) = stood
    assert (holds, reason) == (holds_below, reason_below)
    # a body that balances falls or not by the last bit of its numbers, which are about another
    # frame
    assert abs(falls - falls_below) <= 1
    assert env.state.base_pos[:, 2].max() < 0.3 * height


@pytest.mark.parametrize(("kind", "height"), [("biped", 0.5), ("humanoid", 1.2), ("quadruped", 0.3)])
def test_units_of_the_body_do_not_depend_on_its_frame(tmp_path, kind, height):
    """A frame at the soles made a torque cost a million times as much, one below them nothing."""
    text = bodies.urdf(bodies.draw(kind, "body", np.random.default_rng(7)))
    costs: dict[str, list[float]] = {"scaled_torques_l2": [], "scaled_acc_l2": []}
    for name, own in (("as_drawn", text), ("moved", moved_frame(text, height))):
        file = tmp_path / f"{name}.urdf"
        file.write_text(own)
        config = str(new_robot(file, tmp_path / f"draft_{name}.toml").path)
        for term, power in (("scaled_torques_l2", 2), ("scaled_acc_l2", -2)):
            only = (f"rewards.only={{{term}={{weight=-1.0}}}}", f"robot_overrides.draft_{name}.reward_set=only")
            env = polypod.make("velocity_flat_legged", 1, robots=[config], seed=0, overrides=only)
            env.reset()
            stands = np.zeros((1, env.sim.num_actions), dtype=np.float32)
            cost = -sum(float(env.step(stands)[1][0]) for _ in range(5))
            (info,) = simulated.robots(env.sim).values()
            assert simulated.standing_height(info) > 0.4 * (info["base_height"] + info["hip_height"])
            costs[term].append(cost * simulated.standing_height(info) ** power)
    # speeds at the beginning are drawn for the frame, so that motions differ
    for drawn, moved in costs.values():
        assert drawn / 2 < moved < 2 * drawn


def crooked(forward, ankle):
    """A biped with hip axes between x and z.

    Its knees are straight at their stop, its toes ahead of the ankles.
    """
    limits = (-1.9, 1.0, 20.0, 15.0)
    parts = [link("trunk", 9.0, (0.12, 0.16, 0.24), at=(-0.03, 0.0, 0.12))]
    for name, side in (("l", 1), ("r", -1)):
        parts += [
            link(f"{name}1", 0.6, (0.06, 0.06, 0.06)),
            link(f"{name}2", 0.6, (0.06, 0.06, 0.06)),
            link(f"{name}3", 0.9, (0.06, 0.05, 0.12), at=(0.0, 0.0, -0.07)),
            link(f"{name}4", 0.5, (0.05, 0.05, 0.14), at=(0.0, 0.0, -0.08)),
            link(f"{name}5", 0.1, (0.03, 0.03, 0.03)),
            link(f"{name}6", 0.3, (0.2, 0.07, 0.03), at=(forward, 0.0, -0.03)),
            joint(f"{name}a", "trunk", f"{name}1", (0.0, side * 0.08, -0.03), "0.707107 0 0.707107", limits),
            joint(f"{name}b", f"{name}1", f"{name}2", (-0.02, 0.0, -0.05), "0.707107 0 -0.707107", (-0.9, 0.9, 20, 15)),
            joint(f"{name}c", f"{name}2", f"{name}3", (0.03, -side * 0.02, -0.04), "0 1 0", limits),
            joint(f"{name}d", f"{name}3", f"{name}4", (0.0, -side * 0.02, -0.15), "0 1 0", (0.0, 2.4, 20.0, 15.0)),
            joint(f"{name}e", f"{name}4", f"{name}5", (0.0, 0.0, -0.16), "0 1 0", (-ankle, ankle, 20.0, 15.0)),
            joint(f"{name}f", f"{name}5", f"{name}6", (forward, 0.0, -0.05), "1 0 0", (-0.26, 0.26, 20.0, 15.0)),
        ]
    return f'<robot name="crooked">{"".join(parts)}</robot>'


@pytest.mark.parametrize(("forward", "ankle"), [(0.02, 0.79), (0.04, 0.6), (0.05, 0.7)])
def test_knees_that_are_straight_at_their_stop_are_bent(tmp_path, forward, ankle):
    file = tmp_path / "crooked.urdf"
    file.write_text(crooked(forward, ankle))
    made = new_robot(file, tmp_path / "draft.toml")
    assert not [note for note in made.notes if "where it should stand" in note]
    assert made.pose_holds, made
    pose = tomllib.loads(made.path.read_text())["default_pose"]
    for side in ("L", "R"):
        assert pose[f"{side}_KNEE"] > 0.3, pose
    assert pose["L_KNEE"] == pytest.approx(pose["R_KNEE"], abs=2e-3)


@pytest.mark.parametrize("tilt", [3.7e-6, -5e-6, 6e-5, 8e-4])
def test_soles_that_are_level_but_for_rounding_are_stood_on_in_the_middle(tmp_path, tilt):
    """Left and right of a body stand equally where the maker rounds right angles."""
    text = crooked(0.02, 0.79)
    for name, sign in (("l6", 1), ("r6", -1)):
        at = text.index("<collision><origin", text.index(f'<link name="{name}">'))
        end = text.index("/>", at)
        text = f'{text[:end]} rpy="{sign * tilt} {tilt} 0"{text[end:]}'
    poses = []
    for name, own in (("tilted", text), ("level", crooked(0.02, 0.79))):
        draft = _core.draft_robot(write(tmp_path / f"{name}.urdf", own))
        poses.append(tomllib.loads(draft["toml"])["default_pose"])
    assert poses[0] == pytest.approx(poses[1], abs=2e-3)


@pytest.mark.parametrize("part", ["pads", "pads_and_shanks"])
def test_feet_whose_meshes_are_missing_are_boxes_of_their_inertia(tmp_path, part):
    mesh = '<mesh filename="package://fox/part.stl"/>'
    text = quadruped().replace('<sphere radius="0.025"/>', mesh)
    text = text.replace('<box size="0.03 0.03 0.24"/>', mesh) if part == "pads_and_shanks" else text
    file = tmp_path / "fox.urdf"
    file.write_text(text)
    made = new_robot(file, tmp_path / "draft.toml")
    assert made.standing.holds, made
    feet = set(tomllib.loads(made.path.read_text())["feet"].values())
    if part == "pads":
        # the shanks have shapes to stand on
        assert feet == {"c0", "c1", "c2", "c3"}
        return
    assert feet == {"pad0", "pad1", "pad2", "pad3"}
    (note,) = (note for note in made.notes if "the box of its inertia" in note and "pad0" in note)
    assert "collision meshes are missing" in note
    # 0.3 m below the knee, half of the cube of 3 cm with the pad's inertia
    (info,) = json.loads(is_usable(made).sim.robot_info()).values()
    known = new_robot(write(tmp_path / "whole.urdf", quadruped()), tmp_path / "whole.toml")
    (of_known,) = json.loads(is_usable(known).sim.robot_info()).values()
    assert info["base_height"] == pytest.approx(of_known["base_height"], abs=0.1)


def test_what_is_above_an_ankle_is_no_foot(tmp_path):
    """A foot without shape and with almost no inertia: its shank reaches the ground first."""
    text = without_shapes(crooked(0.02, 0.79), ("l5", "l6", "r5", "r6"))
    for name in ("l6", "r6"):
        at = text.index('<mass value="', text.index(f'<link name="{name}">'))
        text = f'{text[:at]}<mass value="0.0005"{text[text.index("/>", at) :]}'
    with pytest.raises(_core.RobotError, match="leg L has no collision shape for a foot there"):
        new_robot(write(tmp_path / "crooked.urdf", text), tmp_path / "draft.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["crooked.urdf"]


def without_shapes(text, links):
    for name in links:
        at = text.index(f'<link name="{name}">')
        begin, end = text.index("<collision>", at), text.index("</collision>", at) + len("</collision>")
        text = text[:begin] + text[end:]
    return text


ALL_OF_THE_LEGS = ("l1", "l2", "l3", "l4", "l5", "l6", "r1", "r2", "r3", "r4", "r5", "r6")


@pytest.mark.parametrize("links", [("l6", "r6"), ("l5", "l6", "r5", "r6"), ALL_OF_THE_LEGS])
def test_feet_of_a_file_without_shapes_are_boxes_of_their_inertia(tmp_path, links):
    """In a copy of the file next to the draft; the file itself is refused by every reader."""
    whole = crooked(0.02, 0.79)
    text = without_shapes(whole, links)
    urdf = write(tmp_path / "maker" / "bare.urdf", text)
    made = new_robot(urdf, tmp_path / "draft.toml")
    assert urdf.read_text() == text
    config = tomllib.loads(made.path.read_text())
    assert config["urdf"] == "bare_with_feet.urdf"
    assert config["feet"] == {"L": "l6", "R": "r6"}
    notes = [note for note in made.notes if "no limb's end has a <collision>" in note]
    assert [note.split('"')[1] for note in notes] == ["l6", "r6"]
    assert made.pose_holds, made
    (info,) = json.loads(is_usable(made).sim.robot_info()).values()
    # the feet's shapes were boxes of uniform density
    known = new_robot(write(tmp_path / "whole.urdf", whole), tmp_path / "whole.toml")
    (of_known,) = json.loads(is_usable(known).sim.robot_info()).values()
    assert info["base_height"] == pytest.approx(of_known["base_height"], abs=1e-3)
    # other readers see what the file says
    assert "l6" not in [
        body.split()[0] for body in _core.check(urdf).partition("contact bodies")[2].splitlines() if body
    ]
    other = new_robot(urdf, tmp_path / "other.toml").path.read_text()
    assert tomllib.loads(other)["urdf"] == "other_with_feet.urdf"
    own = tmp_path / "own" / "bare_with_feet.urdf"
    own.parent.mkdir()
    own.write_text("mine")
    with pytest.raises(_core.ConfigError, match=r"bare_with_feet\.urdf is there already; pass --force"):
        new_robot(urdf, own.with_name("draft.toml"))
    assert own.read_text() == "mine"
    assert new_robot(urdf, tmp_path / "draft.toml", force=True).path == made.path


def test_a_file_with_the_shape_of_one_foot_lacks_the_other(tmp_path):
    """Its maker forgot it: nothing takes its place."""
    text = without_shapes(crooked(0.02, 0.79), ["l6", "l5"])
    with pytest.raises(_core.RobotError, match="leg L has no collision shape for a foot there"):
        new_robot(write(tmp_path / "half.urdf", text), tmp_path / "half.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["half.urdf"]


def test_a_copy_with_boxes_finds_the_meshes_of_the_file(tmp_path):
    """The trunk has a mesh by a relative name, in another folder than the draft."""
    text = without_shapes(crooked(0.02, 0.79), ("l5", "l6", "r5", "r6"))
    text = text.replace('<box size="0.12 0.16 0.24"/>', '<mesh filename="meshes/trunk.obj"/>')
    urdf = write(tmp_path / "maker" / "bare.urdf", text)
    corners = [(x, y, z) for x in (-0.06, 0.06) for y in (-0.08, 0.08) for z in (-0.12, 0.12)]
    write(
        tmp_path / "maker" / "meshes" / "trunk.obj", "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3 4\n"
    )
    (tmp_path / "drafts").mkdir()
    made = new_robot(urdf, tmp_path / "drafts" / "draft.toml")
    assert "../maker/meshes/trunk.obj" in (tmp_path / "drafts" / "bare_with_feet.urdf").read_text()
    assert not [note for note in made.notes if "trunk.obj" in note and "not found" in note], made.notes
    is_usable(made)


@pytest.mark.parametrize("aside", [0.0, 0.06])
def test_a_waist_between_the_base_and_the_legs_is_a_torso(tmp_path, aside):
    """A joint about y may have its origin anywhere on its axis, off the middle too."""
    text = crooked(0.02, 0.79).replace('"trunk"', '"pelvis"').replace("</robot>", "")
    limits = (-0.5, 0.5, 40.0, 15.0)
    text += "".join(
        [
            link("chest", 5.0, (0.12, 0.2, 0.2), at=(-0.02, 0.0, 0.1)),
            link("waist", 0.3, (0.05, 0.05, 0.05)),
            joint("bow", "chest", "waist", (0.0, -aside, 0.0), "0 1 0", limits),
            joint("lean", "waist", "pelvis", (0.0, aside, -0.3), "1 0 0", limits),
            "</robot>",
        ]
    )
    roles = tomllib.loads(_core.draft_robot(write(tmp_path / "diver.urdf", text))["toml"])["joint_roles"]
    assert roles["TORSO_PITCH"] == "bow"
    assert roles["TORSO_ROLL"] == "lean"
    assert roles["L_KNEE"] == "ld"


def write(file, text):
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    return file


@pytest.mark.parametrize(("height", "is_upper_body"), [(0.3, True), (-0.03, False)])
def test_arms_above_a_spine_are_no_legs(tmp_path, height, is_upper_body):
    """Half a humanoid does not walk on its hands."""
    text = crooked(0.02, 0.79).replace('"trunk"', '"chest"').replace("</robot>", "")
    for side in ("0.08", "-0.08"):
        text = text.replace(f'<origin xyz="0.0 {side} -0.03"/>', f'<origin xyz="0.0 {side} {height}"/>')
    limits = (-0.5, 0.5, 40.0, 15.0)
    text += "".join(
        [
            link("block", 5.0, (0.2, 0.2, 0.1)),
            link("spine", 0.3, (0.05, 0.05, 0.05)),
            joint("turn", "block", "spine", (0.0, 0.0, 0.05), "0 0 1", limits),
            joint("bow", "spine", "chest", (0.0, 0.0, 0.0), "0 1 0", limits),
            "</robot>",
        ]
    )
    file = write(tmp_path / "half.urdf", text)
    if is_upper_body:
        with pytest.raises(_core.RobotError, match="legs"):
            _core.draft_robot(file)
    else:
        assert tomllib.loads(_core.draft_robot(file)["toml"])["joint_roles"]["L_KNEE"] == "ld"


@pytest.mark.parametrize(("moment", "is_token"), [(1.0, True), (1e-9, True), (-5e-20, True), (1e-3, False)])
def test_placeholders_of_inertias_give_way_to_bars(tmp_path, moment, is_token):
    """One moment in every link: links of some hundred grams would turn as large balls do."""
    tree = ET.parse(urdf("berkeley_humanoid"))
    for inertia in tree.iter("inertia"):
        inertia.attrib = dict.fromkeys(("ixx", "iyy", "izz"), str(moment)) | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    tree.write(tmp_path / "tokens.urdf")
    made = new_robot(tmp_path / "tokens.urdf", tmp_path / "tokens.toml")
    (own,) = (tmp_path / tomllib.loads(made.path.read_text())["urdf"],)
    moments = [float(inertia.get("iyy")) for inertia in ET.parse(own).iter("inertia")]
    said = [note for note in made.notes if "placeholder (as of" in note]
    if is_token:
        assert own.name == "tokens_with_inertias.urdf"
        assert max(moments) < 0.1
        assert len(said) == 1
        assert made.pose_holds
        is_usable(made)
    else:
        assert own.name == "tokens.urdf"
        assert set(moments) == {moment}
        assert said == []


def test_a_base_that_looks_back_is_turned_round(tmp_path):
    """Where x points to the rear, the left leg is the right one, and ahead is behind."""
    tree = ET.parse(urdf("unitree_g1"))
    base = base_frames._base(tree.getroot())
    base_frames._turn(tree.getroot(), base, np.diag([-1.0, -1.0, 1.0]))
    tree.write(tmp_path / "back.urdf")
    made = new_robot(tmp_path / "back.urdf", tmp_path / "draft_back.toml")
    drafted, kept = (
        tomllib.loads(text) for text in (made.path.read_text(), _core.draft_robot(urdf("unitree_g1"))["toml"])
    )
    assert drafted["urdf"] == "back_turned.urdf"
    assert [note for note in made.notes if "-x is taken for forward" in note]
    assert drafted["joint_roles"] == kept["joint_roles"]
    assert drafted["default_pose"] == pytest.approx(kept["default_pose"], abs=2e-3)
    is_usable(made)


@pytest.mark.parametrize("robot", [*ON_SOLES, *ON_POINTS, "cassie"])
def test_bases_that_look_ahead_stay(robot):
    draft = tomllib.loads(_core.draft_robot(urdf(robot))["toml"])
    assert base_frames.turn_round(ET.parse(urdf(robot)).getroot(), draft) is None


def test_an_uneven_sole_is_as_good_as_a_flat_one(tmp_path):
    """Scanned soles have one lowest vertex, at any place; the foot is the middle of the sole."""
    tree = ET.parse(urdf("booster_t1"))
    for side in ("left", "right"):
        geometry = tree.getroot().find(f'link[@name="{side}_foot_link"]/collision/geometry')
        geometry[:] = [ET.Element("mesh", {"filename": "sole.obj"})]
    # all vertices of the box of 0.223 x 0.1 x 0.03 m; one lies 0.5 mm lower
    corners = [(x, y, z) for x in (-0.1115, 0.1115) for y in (-0.05, 0.05) for z in (-0.015, 0.015)]
    corners[0] = (-0.1115, -0.05, -0.0155)
    faces = [(a, b, c) for a in range(1, 7) for b in range(a + 1, 8) for c in (b + 1,)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "sole.obj").write_text("\n".join(lines) + "\n")
    tree.write(tmp_path / "scanned.urdf")
    scanned, flat = (
        tomllib.loads(_core.draft_robot(file)["toml"]) for file in (tmp_path / "scanned.urdf", urdf("booster_t1"))
    )
    assert scanned["default_pose"] == pytest.approx(flat["default_pose"], abs=0.01)


def add_tips(robot):
    for number in range(2):
        text = f'<joint name="turn{number}" type="revolute"><parent link="torso"/><child link="tip{number}"/>'
        robot.append(
            ET.fromstring(f'{text}<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>')
        )
        robot.append(ET.fromstring(f'<link name="tip{number}"/>'))


def take_masses(robot):
    for name in ("ll_hr", "lr_hr"):
        link = robot.find(f'link[@name="{name}"]')
        link.remove(link.find("inertial"))


def turn_moments(robot):
    for name in ("ll_kfe", "lr_kfe"):
        robot.find(f'link[@name="{name}"]/inertial/inertia').set("iyy", "-0.001")


@pytest.mark.parametrize(
    ("change", "ending", "said"),
    [
        (add_tips, "masses", "tip0: it moves and has no mass; the joint that moves it is fixed: write an <inertial>"),
        (take_masses, "masses", "ll_hr: it moves and has no mass; it gets 1% of the mass that it carries"),
        (turn_moments, "inertias", "ll_kfe: its inertia is not positive definite; that of a bar to its end"),
    ],
)
def test_moving_links_without_mass_or_inertia_are_mended_in_a_copy(tmp_path, change, ending, said):
    tree = ET.parse(urdf("berkeley_humanoid"))
    change(tree.getroot())
    tree.write(tmp_path / "bare.urdf")
    with pytest.raises(_core.RobotError, match=r"has a mass|not positive definite"):
        _core.draft_robot(tmp_path / "bare.urdf")
    made = new_robot(tmp_path / "bare.urdf", tmp_path / "draft_bare.toml")
    assert tomllib.loads(made.path.read_text())["urdf"] == f"bare_with_{ending}.urdf"
    notes = [note.replace('link "', "").replace('"', "").replace(" (like 1 more link)", "") for note in made.notes]
    assert [note for note in notes if note.startswith(said)], made.notes
    known = _core.draft_robot(urdf("berkeley_humanoid"))
    drafted, kept = (tomllib.loads(text) for text in (made.path.read_text(), known["toml"]))
    assert drafted["joint_roles"] == kept["joint_roles"]
    assert drafted["default_pose"] == pytest.approx(kept["default_pose"], abs=0.1)
    is_usable(made)


def test_links_that_carry_a_chain_without_masses_share_its_end(tmp_path):
    """Two of three hinges of a ball joint; names in the order of the file or not."""
    tree = ET.parse(urdf("berkeley_humanoid"))
    robot = tree.getroot()
    for name in ("ll_hr", "ll_haa"):
        link = robot.find(f'link[@name="{name}"]')
        link.remove(link.find("inertial"))
    thigh = float(robot.find('link[@name="ll_hfe"]/inertial/mass').get("value"))
    robot[:] = reversed(robot)
    assert massless_links.settle(robot, ()) == ([], ["ll_haa", "ll_hr"])
    for name in ("ll_hr", "ll_haa"):
        mass = robot.find(f'link[@name="{name}"]/inertial/mass').get("value")
        assert float(mass) == pytest.approx(massless_links.SHARE * thigh)
    assert massless_links.settle(robot, ()) == ([], [])


def hangs(name, parent, at, axis, shape, kind="revolute"):
    """A link of 300 g and the joint above it."""
    moves = (
        f'<joint name="{name}_joint" type="{kind}"><origin xyz="{at}"/><parent link="{parent}"/><child link="{name}"/>'
    )
    limit = '<limit lower="-1" upper="1" effort="5" velocity="10"/>'
    return link(name, 0.3, (0.04, 0.04, 0.04), shape=shape) + f'{moves}<axis xyz="{axis}"/>{limit}</joint>'


def test_an_arm_on_the_back_that_turns_as_a_leg_does_is_no_leg(tmp_path):
    """Its wrist rolls and pitches twice, as a hip and a knee do."""
    places = ("0.1 0 0.1", "0 0 0.05", "0.2 0 0", "0.2 0 0", "0.05 0 0", "0.05 0 0", "0.05 0 0")
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0")
    parents = ("trunk", *(f"arm{at}" for at in range(6)))
    arm = "".join(
        hangs(f"arm{at}", parent, place, axis, None)
        for at, (parent, place, axis) in enumerate(zip(parents, places, axes, strict=True))
    )
    (tmp_path / "back.urdf").write_text(quadruped().replace("</robot>", f"{arm}</robot>"))
    made = new_robot(tmp_path / "back.urdf", tmp_path / "back.toml")
    assert made.is_quadruped
    assert made.standing.holds
    assert set(tomllib.loads(made.path.read_text())["locked_joints"]) == {f"arm{at}_joint" for at in range(7)}
    # one line for all of them
    (note,) = (note for note in made.notes if note.startswith("[locked_joints]"))
    assert note.endswith("is no leg's and is held at 0 (as are 6 more)")


def test_a_wheel_below_a_ball_is_the_foot(tmp_path):
    """The ball is the shank's end; the robot stands on what reaches clearly farther."""
    text = quadruped()
    ends = [f"pad{at}" for at in range(4)]
    assert all(f'<link name="{end}">' in text for end in ends)
    wheel = '<cylinder radius="0.05" length="0.04"/>'
    wheels = "".join(hangs(f"wheel_{end}", end, "0 0 -0.03", "0 1 0", wheel, "continuous") for end in ends)
    # the axle lies across
    wheels = wheels.replace("<collision><origin xyz", '<collision><origin rpy="1.5708 0 0" xyz')
    (tmp_path / "wheels.urdf").write_text(text.replace("</robot>", f"{wheels}</robot>"))
    made = new_robot(tmp_path / "wheels.urdf", tmp_path / "wheels.toml")
    assert made.standing.holds
    assert made.standing.carried > 0.95
    assert set(tomllib.loads(made.path.read_text())["feet"].values()) == {f"wheel_{end}" for end in ends}
