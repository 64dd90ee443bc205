"""A config and its URDF, or two lines of a config, agree: errors name joint, range and remedy."""

import functools

import pytest

import polypod
from go2 import limits, without_actuator_limits, write_go2


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Writes the robot `mine`: a Go2 with an edited URDF, and lines on top of its TOML."""
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    return functools.partial(write_go2, tmp_path)


def refusal(**options):
    with pytest.raises(polypod.ConfigError) as caught:
        polypod.make("velocity_flat", 2, robots=["mine"], seed=1, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("angle", [-5.0, 45.0, -0.5])
def test_the_default_pose_is_within_the_limits(mine, angle):
    mine(lines=f"[default_pose]\nLF_KFE = {angle}\n")
    message = refusal()
    for word in ("mine.toml", "default_pose.LF_KFE", f"{angle:g}", "FL_calf_joint", "-2.7227 .. -0.83776", "between"):
        assert word in message


def test_a_task_cannot_move_it_out_of_them(mine):
    mine()
    message = refusal(overrides=["robot_overrides.mine.default_pose.RH_HFE=-4.0"])
    assert "robot_overrides.mine" in message
    assert "RR_thigh_joint" in message


@pytest.mark.parametrize(
    ("mode", "span"), [("offset", "[5.0, 6.0]"), ("offset", "[-9.0, -8.0]"), ("scale", "[4.0, 5.0]")]
)
def test_episodes_begin_within_the_limits(mine, mode, span):
    mine(lines=f'[reset]\njoint_position = {{ mode = "{mode}", range = {span} }}\n')
    message = refusal()
    assert "reset.joint_position.range" in message
    assert "soft limits" in message


def test_soft_limits_leave_the_positions_of_a_reset(mine):
    mine(lines="[reset]\nsoft_limit_factor = 0.01\n")
    message = refusal()
    assert "soft_limit_factor" in message
    assert "LF_" in message


def test_joints_are_locked_within_their_limits(mine):
    def finger(urdf):
        inertia = '<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/>'
        body = f'<inertial><mass value="0.1"/>{inertia}</inertial>'
        parts = f'<link name="finger">{body}</link><joint name="finger_1" type="prismatic"><parent link="base"/>'
        parts += '<child link="finger"/><limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>'
        return urdf.replace("</robot>", parts + "</robot>")

    mine(finger, "[locked_joints]\nfinger_1 = 5.0\n")
    message = refusal()
    for word in ("locked_joints.finger_1", "5", "0 .. 0.04"):
        assert word in message
    mine(finger, "[locked_joints]\nfinger_1 = 0.03\n")
    polypod.make("velocity_flat", 2, robots=["mine"], seed=1)


def test_a_base_keeps_some_of_its_mass(mine):
    mine(lines="[randomization]\nbase_mass_offset = [-100.0, -100.0]\n")
    message = refusal()
    assert "randomization.base_mass_offset" in message
    assert "kg" in message


def test_a_motor_has_some_effort(mine):
    mine(limits("FL_calf_joint", lambda tag: tag.replace("45.43", "0")), toml=without_actuator_limits())
    message = refusal()
    assert "FL_calf_joint" in message
    assert "effort_limit" in message


def test_robots_have_names():
    with pytest.raises(polypod.ConfigError, match=r"robots\[0\]"):
        polypod.make("velocity_flat", 2, robots=["spot"], overrides=["robots=['']"])


def test_an_episode_is_longer_than_a_step():
    with pytest.raises(polypod.ConfigError, match="episode_length_s"):
        polypod.make("velocity_flat", 2, robots=["spot"], overrides=["sim.episode_length_s=0.02"])
