"""Drafts of the library's URDFs against people's configs of them.

Also limits that a URDF does not say.
"""

import json
import re

import numpy as np
import pytest
import tomllib
from test_drafts_of_any_class import crooked, folded
from test_new_robot import joint, link, quadruped

import polypod
from common import ROOT
from polypod import _core, bodies

TASK = "velocity_flat_any_legged_play"
QUADRUPEDS = [
    path.stem
    for path in sorted((ROOT / "configs/robots").glob("*.toml"))
    if any(joint.endswith("_KFE") for joint in tomllib.loads(path.read_text())["default_pose"])
]
FACTOR = 2.0
"""Between what is drafted and what is written by hand."""


def draft_of(text, tmp_path, **options):
    """The TOML of a draft, its path and its notes."""
    file = tmp_path / f"{options.get('name', 'robot')}.urdf"
    file.write_text(text)
    draft = _core.draft_robot(file, urdf=str(file), **options)
    path = tmp_path / f"{draft['name']}.toml"
    path.write_text(draft["toml"])
    return tomllib.loads(draft["toml"]), path, draft["notes"]


def info_of(robot):
    sim = _core.VecSim(TASK, 1, robots=[str(robot)], threads=1)
    (info,) = json.loads(sim.robot_info()).values()
    return info


def by_slot(info, key):
    return {slot: info[key][joint] for slot, joint in zip(info["slots"], info["joint_of_slot"], strict=True)}


def within(factor, drafted, made):
    return made / factor <= drafted <= made * factor


def test_there_are_quadrupeds():
    assert len(QUADRUPEDS) >= 16


@pytest.mark.parametrize("robot", QUADRUPEDS)
def test_gains_of_quadrupeds_are_those_of_makers_within_a_factor(tmp_path, robot):
    config = tomllib.loads((ROOT / f"configs/robots/{robot}.toml").read_text())
    text = (ROOT / config["urdf"]).read_text()
    _, path, _ = draft_of(text, tmp_path, name="drafted", locked_joints=config.get("locked_joints", {}))
    drafted, made = info_of(path), info_of(robot)
    assert within(FACTOR, drafted["action_scale"], made["action_scale"])
    assert within(1.25, drafted["base_height"], made["base_height"])
    for key in ("stiffness", "damping", "effort_limit"):
        own, known = by_slot(drafted, key), by_slot(made, key)
        for slot in (slot for slot in own if slot.endswith(("_HAA", "_HFE", "_KFE"))):
            assert within(FACTOR, own[slot], known[slot]), (slot, key, own[slot], known[slot])


@pytest.mark.parametrize(("mass", "least", "most"), [(3.0, 0.03, 0.05), (15.0, 0.027, 0.029), (80.0, 0.027, 0.029)])
def test_heavy_quadrupeds_are_damped_as_others_and_light_ones_more(tmp_path, mass, least, most):
    """Damping over stiffness, s; makers' robots of 60 to 75 kg have 0.025 to 0.032."""
    size = (mass / 15.0) ** (1.0 / 3.0)
    text = quadruped(mass, 0.25 * size, 0.25 * size, 0.5 * size, effort=40.0 * size**4)
    groups = draft_of(text, tmp_path)[0]["actuators"].values()
    assert all(least <= group["damping"] / group["stiffness"] <= most for group in groups)


@pytest.mark.parametrize(("leg", "least", "most"), [(0.4, 0.09, 0.11), (0.65, 0.14, 0.17), (1.2, 0.24, 0.26)])
def test_legs_that_are_long_for_their_distance_lean_farther_outwards(tmp_path, leg, least, most):
    """Feet that are near to each other tip over; to lean by more than 0.25 rad is no maker's."""
    pose = draft_of(quadruped(thigh=0.47 * leg, shank=0.53 * leg), tmp_path)[0]["default_pose"]
    angles = [side * pose[f"{place}_HAA"] for side, legs in ((1, "LF LH"), (-1, "RF RH")) for place in legs.split()]
    assert all(least <= angle <= most for angle in angles), angles
    assert max(angles) - min(angles) < 0.01


def test_bodies_whose_knees_point_to_each_other_stand_taller(tmp_path):
    """As the makers of robots with such knees have them: at 0.84 of the leg's length, not 0.72."""
    text = quadruped()
    pointing = re.sub(
        r'(name="m[23]3".*?)lower="-2.6" upper="-0.3"', r'\1lower="0.3" upper="2.6"', text, flags=re.DOTALL
    )
    assert pointing.count('lower="0.3"') == 2
    usual, tall = (draft_of(robot, tmp_path)[0]["default_pose"] for robot in (text, pointing))
    assert [usual["LF_KFE"], usual["LH_KFE"]] == pytest.approx([-1.5, -1.5], abs=0.1)
    assert [tall["LF_KFE"], tall["LH_KFE"]] == pytest.approx([-1.0, 1.0], abs=0.1)


def test_hips_that_reach_no_farther_lean_as_usual(tmp_path):
    text = quadruped(thigh=0.4, shank=0.5)
    narrow = text.replace('lower="-0.8" upper="0.8"', 'lower="-0.16" upper="0.16"')
    assert narrow != text
    draft, _, notes = draft_of(narrow, tmp_path)
    assert 0.09 <= draft["default_pose"]["LF_HAA"] <= 0.11
    assert not any("default_pose" in note for note in notes), notes


LIMITS = re.compile(r'(effort|velocity)="[^"]*"')


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"effort": "0", "velocity": "0"}, ("has no effort limit", "has no velocity limit")),
        (
            {"effort": "1000", "velocity": "1000"},
            ("effort limit of 1000 N m is no motor's", "velocity limit of 1000 rad/s is no motor's"),
        ),
    ],
    ids=["none", "placeholders"],
)
@pytest.mark.parametrize("robot", ["unitree_a1", "anymal_d", "solo12", "unitree_b2"])
def test_limits_that_no_motor_has_follow_from_the_body(tmp_path, robot, limits, words):
    config = tomllib.loads((ROOT / f"configs/robots/{robot}.toml").read_text())
    text = (ROOT / config["urdf"]).read_text()
    text = LIMITS.sub(lambda found: f'{found[1]}="{limits[found[1]]}"', text)
    _, path, notes = draft_of(text, tmp_path, name="drafted")
    drafted, made = info_of(path), info_of(robot)
    for key, factor in (("stiffness", FACTOR), ("effort_limit", FACTOR), ("velocity_limit", 2.5)):
        own, known = np.mean(drafted[key]), np.mean(made[key])
        assert within(factor, own, known), (key, own, known)
    for word in words:
        (note,) = (note for note in notes if word in note)
        assert "write the motor's" in note
        assert all(name in note for name in drafted["joint_names"])
    assert path.read_text().count("assumed: not in the URDF") == 2


def test_limits_of_motors_stay(tmp_path):
    config, _, notes = draft_of(quadruped(), tmp_path)
    assert {group["effort_limit"] for group in config["actuators"].values()} == {60.0, 90.0}
    assert {group["velocity_limit"] for group in config["actuators"].values()} == {20.0, 14.0}
    assert not any("[actuators]" in note for note in notes)


def commands_of(text, tmp_path):
    return draft_of(text, tmp_path)[0]["commands"]["base_velocity"]


def test_commands_follow_from_the_legs(tmp_path):
    """Speeds grow with the root of the length, and legs are asked for what their joints can do."""
    small, large = (commands_of(quadruped(5.0, leg, leg, 0.4), tmp_path) for leg in (0.08, 0.32))
    assert large["lin_vel_x"][1] == pytest.approx(2 * small["lin_vel_x"][1], rel=0.05)
    assert large["lin_vel_x"][1] == pytest.approx(np.sqrt(0.25 * 9.81 * 0.64), rel=0.05)
    assert small["lin_vel_y"] == small["lin_vel_x"]
    assert large["ang_vel_z"] == [-1.0, 1.0]


def test_legs_without_abduction_are_not_asked_for_side_steps(tmp_path):
    text = bodies.urdf(bodies.draw("quadruped8", "body", np.random.default_rng(7)))
    config, path, notes = draft_of(text, tmp_path)
    box = config["commands"]["base_velocity"]
    assert box["lin_vel_y"] == [0.0, 0.0]
    assert box["ang_vel_z"] == [-0.5, 0.5]
    assert sum("not asked for side-steps" in note for note in notes) == 1
    (ranges,) = _core.VecSim(TASK, 1, robots=[str(path)], threads=1).command_ranges().values()
    assert ranges["lin_vel_y"] == (0.0, 0.0) or ranges["lin_vel_y"] == [0.0, 0.0]


def planar_biped():
    """Two legs that move to and fro alone."""
    parts = [link("trunk", 4.0, (0.15, 0.2, 0.3), at=(0.0, 0.0, 0.15))]
    limits = (-1.5, 1.5, 20.0, 15.0)
    for name, y in (("l", 0.1), ("r", -0.1)):
        parts += [
            link(f"{name}1", 0.5, (0.05, 0.05, 0.2), at=(0.0, 0.0, -0.1)),
            link(f"{name}2", 0.3, (0.05, 0.05, 0.2), at=(0.0, 0.0, -0.1)),
            link(f"{name}3", 0.1, (0.15, 0.06, 0.02), at=(0.0, 0.0, -0.01)),
            joint(f"{name}a", "trunk", f"{name}1", (0.0, y, 0.0), "0 1 0", limits),
            joint(f"{name}b", f"{name}1", f"{name}2", (0.0, 0.0, -0.2), "0 1 0", (-0.1, 2.0, 20.0, 15.0)),
            joint(f"{name}c", f"{name}2", f"{name}3", (0.0, 0.0, -0.2), "0 1 0", limits),
        ]
    return f'<robot name="planar">{"".join(parts)}</robot>'


def test_two_legs_that_neither_spread_nor_turn_go_straight(tmp_path):
    config, _, notes = draft_of(planar_biped(), tmp_path)
    assert config["commands"]["base_velocity"]["lin_vel_y"] == [0.0, 0.0]
    assert config["commands"]["base_velocity"]["ang_vel_z"] == [0.0, 0.0]
    assert any("neither side-steps nor turns" in note for note in notes)
    others = commands_of(crooked(0.02, 0.79), tmp_path)
    assert others["lin_vel_y"][1] > 0.0
    assert others["ang_vel_z"] == [-1.0, 1.0]


def with_linkage(text, parent, mass):
    """A gear and a rod with its crank on a link."""
    parts = [
        link("gear", mass, (0.02, 0.02, 0.005)),
        link("crank", mass, (0.02, 0.02, 0.005)),
        link("rod", mass, (0.01, 0.01, 0.1)),
        joint("drive", parent, "gear", (0.02, 0.0, 0.08), "0 0 1", (-2.8, 2.8, 1.0, 20.0)),
        joint("turn", parent, "crank", (-0.02, 0.0, 0.08), "0 1 0", (-6.2, 6.2, 1.0, 20.0)),
        joint("follow", "crank", "rod", (0.0, 0.0, 0.02), "0 1 0", (-6.2, 6.2, 1.0, 20.0)),
    ]
    return text.replace("</robot>", "".join(parts) + "</robot>")


@pytest.mark.parametrize("body", ["humanoid", "biped", "hexapod"])
def test_rods_and_gears_of_linkages_are_held(tmp_path, body):
    """They are no heads and no tails; and what weighs as much as a head is one."""
    text = bodies.urdf(bodies.draw(body, "body", np.random.default_rng(7)))
    base = re.search(r'<link name="(\w+)">', text)[1]
    mass = sum(map(float, re.findall(r'<mass value="([^"]*)"', text)))
    plain, _, _ = draft_of(text, tmp_path)
    config, path, notes = draft_of(with_linkage(text, base, 4e-4 * mass), tmp_path)
    assert set(config["locked_joints"]) == {"drive", "turn", "follow"}
    assert config["joint_roles"] == plain["joint_roles"]
    assert sum("is a rod or a gear of a linkage" in note for note in notes) == 3
    assert info_of(path)["class"] == body
    heavy, _, _ = draft_of(with_linkage(text, base, 2e-2 * mass), tmp_path)
    assert {"drive", "turn", "follow"} <= set(heavy["joint_roles"].values()) | set(heavy.get("locked_joints", {}))
    assert "drive" in heavy["joint_roles"].values()
    named, _, _ = draft_of(with_linkage(text, base, 4e-4 * mass), tmp_path, joint_roles={"HEAD_YAW": "drive"})
    assert named["joint_roles"]["HEAD_YAW"] == "drive"


def described(path):
    """Numbers of the joints, [number, slot]."""
    sim = _core.VecSim(
        TASK, 1, robots=[str(path)], overrides=['observations.policy=[{term="joint_descriptors"}]'], threads=1
    )
    sim.reset()
    return np.asarray(sim.observation[0]).reshape(19, -1)


def straightened(text):
    """The same robot, its knees and hips counted from the hanging leg."""
    for number in range(4):
        # thighs to the rear and shanks to the front at zero
        for name, turned, turn in ((f"m{number}2", -np.pi / 2, np.pi / 2), (f"m{number}3", np.pi, np.pi)):
            begin = text.index(f'<joint name="{name}"')
            end = text.index("</joint>", begin)
            own = text[begin:end]
            own = own.replace("<origin ", f'<origin rpy="0 {turned} 0" ')
            low, high = (float(re.search(f'{key}="([^"]*)"', own)[1]) - turn for key in ("lower", "upper"))
            own = re.sub(r'lower="[^"]*" upper="[^"]*"', f'lower="{low}" upper="{high}"', own)
            text = text[:begin] + own + text[end:]
    return text


def test_a_folded_zero_does_not_reach_the_policy(tmp_path):
    """Angles of a description count from the hanging leg, wherever the maker counts from."""
    text = folded((-1, 0, 0), (1, 0, 0), "0 -1 0", (-0.5, 3.1))
    numbers = []
    for name, own in (("folded", text), ("straight", straightened(text))):
        _, path, _ = draft_of(own, tmp_path, name=name)
        numbers.append(described(path))
        slots = info_of(path)["slots"]
    assert numbers[0] == pytest.approx(numbers[1], abs=5e-3)
    for column, slot in enumerate(slots):
        default, lower, upper = numbers[0][6:9, column]
        assert lower < default < upper
        if slot.endswith("_KFE"):
            assert -1.9 < default < -1.0, (slot, default)
    # the maker's own angles are others
    assert by_slot(info_of(tmp_path / "folded.toml"), "default_pose")["LF_KFE"] > 1.0


def test_scaled_descriptions_of_bodies_of_one_shape_are_equal(tmp_path):
    """Twice as long, eight times as heavy, motors in proportion.

    One network sees one robot, but for its size.
    """
    rows = []
    for factor in (1.0, 2.0):
        _, path, _ = draft_of(scaled_fox(factor), tmp_path)
        # light robots are drafted stiffer than in proportion
        toml = path.read_text()
        for gain, value in (("stiffness", 40.0 * factor**4), ("damping", factor**4.5)):
            toml = re.sub(rf"(?m)^{gain} = [\d.]+", f"{gain} = {value}", toml)
        path.write_text(toml)
        rows.append(described_in_units_of_the_body(path))
    assert rows[0][:18] == pytest.approx(rows[1][:18], rel=0.05, abs=0.02)
    assert rows[1][18] == pytest.approx(np.sqrt(2.0) * rows[0][18], rel=1e-3)
    assert np.abs(rows[0]).max() <= 4.0


def scaled_fox(factor):
    """A quadruped whose lengths are multiplied.

    Masses grow with the cube, torques with the fourth power.
    """
    text = quadruped(10.0 * factor**3, 0.2 * factor, 0.2 * factor, 0.5 * factor, effort=30.0 * factor**4)
    for fixed in ('size="0.08 0.08 0.08"', 'radius="0.025"'):
        text = text.replace(fixed, re.sub(r"0\.\d+", lambda found: str(float(found[0]) * factor), fixed))
    text = re.sub(r'xyz="([-\d.]+) (-?0\.(?:1|07)) ', lambda m: f'xyz="{m[1]} {float(m[2]) * factor} ', text)
    return re.sub(r'velocity="([\d.]+)"', lambda m: f'velocity="{float(m[1]) / np.sqrt(factor)}"', text)


def described_in_units_of_the_body(path):
    sim = _core.VecSim(
        TASK,
        1,
        robots=[str(path)],
        overrides=['observations.policy=[{term="joint_descriptors",units="body"}]'],
        threads=1,
    )
    sim.reset()
    return np.asarray(sim.observation[0]).reshape(19, -1)


def test_unknown_parameters_of_descriptions_are_refused():
    with pytest.raises(_core.ConfigError, match="did you mean `units`"):
        polypod.make(
            TASK, 1, robots=["spot"], overrides=['observations.policy=[{term="joint_descriptors",unit="body"}]']
        )


@pytest.mark.parametrize("below", [0.05, 0.12])
def test_a_thigh_below_the_axis_of_abduction_bends_no_further(tmp_path, below):
    """The height of the pose counts from the thigh, as in HyQ."""
    # short legs: they need not lean farther outwards for the height
    short = quadruped(thigh=0.16, shank=0.17)
    plain, _, _ = draft_of(short, tmp_path)
    thighs = r'(<joint name="m\d2"[^>]*><origin xyz="0\.0 -?0\.07) 0\.0"'
    text, count = re.subn(thighs, rf'\1 {-below}"', short)
    assert count == 4
    lower, _, _ = draft_of(text, tmp_path)
    for slot, angle in plain["default_pose"].items():
        assert lower["default_pose"][slot] == pytest.approx(angle, abs=0.05), slot


@pytest.mark.parametrize(("knees", "sign"), [("-6.28", 1), ("-9.42", 1), ("-6.28", -1)])
def test_knees_that_turn_freely_are_limited(tmp_path, knees, sign):
    """In the URDF they pass straight.

    The draft says which limits it assumes, and the simulation has them.
    """
    text = quadruped()
    for number in range(4):
        begin = text.index(f'<joint name="m{number}3"')
        end = text.index("</joint>", begin)
        own = re.sub(r'lower="[^"]*" upper="[^"]*"', f'lower="{knees}" upper="{knees[1:]}"', text[begin:end])
        own = own if sign > 0 else own.replace('"0 1 0"', '"0 -1 0"')
        text = text[:begin] + own + text[end:]
    config, path, notes = draft_of(text, tmp_path)
    assert config["joint_limits"] == {f"{leg}_KFE": [-2.7, -0.3] for leg in ("LF", "LH", "RF", "RH")}
    (note,) = (note for note in notes if "[joint_limits]" in note)
    assert "LF_KFE, LH_KFE, RF_KFE, RH_KFE turn freely" in note
    info = info_of(path)
    for slot, lower in by_slot(info, "lower").items():
        upper = by_slot(info, "upper")[slot]
        if slot.endswith("_KFE"):
            assert [lower, upper] == pytest.approx([-2.7, -0.3] if sign > 0 else [0.3, 2.7])
    assert "joint_limits" not in draft_of(quadruped(), tmp_path)[0]


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ("LF_KFE=[-1.0, -2.0]", ("joint_limits.LF_KFE", "is not below")),
        ("LF_KFE=[1.0, 2.0]", ("joint_limits.LF_KFE", "nothing in common")),
        ("L_KNEE=[0.0, 1.0]", ("joint_limits.L_KNEE", "no such joint")),
        ("LF_KNE=[0.0, 1.0]", ("joint_limits.LF_KNE", "unknown key")),
        ("LF_KFE=[-2.7, -1.9]", ("default_pose.LF_KFE", "outside the limits")),
    ],
)
def test_limits_that_do_not_fit_are_refused(limits, words):
    joint, _, numbers = limits.partition("=")
    with pytest.raises(_core.ConfigError) as error:
        _core.VecSim(
            TASK, 1, robots=["unitree_go2"], overrides=[f"robot_overrides.unitree_go2.joint_limits.{joint}={numbers}"]
        )
    for word in words:
        assert word in str(error.value)


def test_limits_narrow_those_of_the_urdf():
    change = "robot_overrides.unitree_go2.joint_limits.LF_KFE=[-2.0, 1.0]"
    sim = _core.VecSim(TASK, 1, robots=["unitree_go2"], overrides=[change])
    (info,) = json.loads(sim.robot_info()).values()
    known = info_of("unitree_go2")
    assert by_slot(info, "lower")["LF_KFE"] == -2.0
    assert by_slot(info, "upper")["LF_KFE"] == by_slot(known, "upper")["LF_KFE"]
    assert by_slot(info, "lower")["LH_KFE"] == by_slot(known, "lower")["LH_KFE"]
