"""The loops of a deployed policy need no polypod, and every fault ends in the damping mode.

They read the messages of makers in the makers' order, and give the same numbers in Python and in
C++.
"""

import dataclasses
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import deployed
from common import ROOT
from polypod import bundled
from polypod.deploy import files
from polypod.deploy.header import header_of
from polypod.deploy.onboard import ros2_control, unitree
from polypod.deploy.onboard.policy_contract import Contract, read_contract
from polypod.deploy.onboard.policy_loop import Loop, Sensors, network_of, open_file, open_loop
from polypod.export import OnnxPolicy, interfaces
from polypod.export import contract as contracts
from polypod.runs import run_dir

DRIVER = ROOT / "tests" / "data" / "deploy" / "loop_of_lines.cpp"


@pytest.fixture
def loop(deployed_policies):
    """A walking loop."""
    loop = open_loop(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    loop.walk(at_once=True)
    return loop


def measured(loop, time=0.0, **changes):
    still = Sensors(
        time=time,
        joint_pos=loop.default_pos,
        joint_vel=np.zeros(len(loop.default_pos)),
        quaternion=[1.0, 0.0, 0.0, 0.0],
        angular_velocity=[0.0, 0.0, 0.0],
        linear_velocity=[0.0, 0.0, 0.0],
    )
    return dataclasses.replace(still, **changes)


def joints_with(value):
    return lambda loop: {"joint_pos": np.where(np.arange(len(loop.default_pos)) == 2, value, loop.default_pos)}


LEAN = [np.cos(0.55), np.sin(0.55), 0.0, 0.0]
"""1.1 rad about the base's x axis."""
FAULTS = {
    "NaN of a joint": (joints_with(np.nan), "sensor_not_finite", "joint_pos"),
    "NaN of the gyroscope": (lambda _: {"angular_velocity": [0.0, np.inf, 0.0]}, "sensor_not_finite", "base_ang_vel"),
    "NaN of the estimator": (lambda _: {"linear_velocity": [np.nan, 0.0, 0.0]}, "sensor_not_finite", "base_lin_vel"),
    "no time": (lambda _: {"time": np.nan}, "sensor_not_finite", "time"),
    "old": (lambda _: {"time": 0.9}, "sensor_stale", "0.100 s old"),
    "of the future": (lambda _: {"time": 1.2}, "sensor_stale", "-0.200 s old"),
    "no quaternion": (lambda _: {"quaternion": [0.0] * 4}, "quaternion_not_unit", "0.000"),
    "a long quaternion": (lambda _: {"quaternion": [1.1, 0.0, 0.0, 0.0]}, "quaternion_not_unit", "1.100"),
    "on its side": (lambda _: {"quaternion": LEAN}, "tilt", "1.10 rad"),
    "upside down": (lambda _: {"quaternion": [0.0, 1.0, 0.0, 0.0]}, "tilt", "3.14 rad"),
    "beyond a limit": (joints_with(-2.9), "joint_limit", "FL_calf_joint is 0.18 beyond"),
    "beyond the other": (joints_with(-0.7), "joint_limit", "FL_calf_joint is 0.14 beyond"),
    "a joint less": (lambda _: {"joint_vel": np.zeros(11)}, "sensor_size", "joint_vel has 11 numbers, not 12"),
    "a list": (lambda _: {"quaternion": [[1.0, 0.0], [0.0]]}, "sensor_size", "ValueError"),
    "a text": (lambda _: {"joint_vel": "fast"}, "sensor_size", "ValueError"),
    "no joints": (lambda _: {"joint_pos": None}, "sensor_missing", "joint_pos"),
    "no estimator": (lambda _: {"linear_velocity": None}, "sensor_missing", "base_lin_vel is not measured"),
}


def is_damped(loop, command, fault):
    assert (command.mode, command.fault) == ("damp", fault)
    assert not command.kp.any()
    assert not command.tau.any()
    np.testing.assert_array_equal(command.kd, loop.contract.safety.damping)
    assert all(np.isfinite(values).all() for values in (command.q, command.dq, command.kp, command.kd, command.tau))
    return True


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_ends_in_the_damping_mode(loop, name):
    changes, fault, detail = FAULTS[name]
    assert loop.step(1.0, measured(loop, 1.0)).mode == "walk"
    command = loop.step(1.0, measured(loop, **({"time": 1.0} | changes(loop))))
    assert is_damped(loop, command, fault)
    assert detail in command.detail
    # latched: sound sensors alone do not let it go on, and neither does a wish to walk
    loop.walk()
    assert is_damped(loop, loop.step(1.02, measured(loop, 1.02)), fault)
    loop.stand()
    assert loop.step(1.04, measured(loop, 1.04)).mode == "stand"
    # the cause is still there
    assert is_damped(loop, loop.step(1.0, measured(loop, **({"time": 1.0} | changes(loop)))), fault)


def test_a_measurement_within_the_bounds_is_no_fault(loop):
    lean = [np.cos(0.45), np.sin(0.45), 0.0, 0.0]
    for changes in (
        {"time": 0.95},
        {"quaternion": lean},
        {"quaternion": [1.04, 0.0, 0.0, 0.0]},
        joints_with(-2.8)(loop),
    ):
        assert loop.step(1.0, measured(loop, **({"time": 1.0} | changes))).mode == "walk"


@pytest.mark.parametrize("command", [(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0)])
def test_a_command_that_is_not_finite_is_a_fault(loop, command):
    assert is_damped(loop, loop.step(0.0, measured(loop), command), "command_not_finite")


def nan_of(name):
    def change(outputs):
        return {key: np.where(key == name, np.nan, value).astype(np.float32) for key, value in outputs.items()}

    return change


def broken(outputs):
    raise RuntimeError("the device is lost")


@pytest.mark.parametrize(
    ("policy", "change"),
    [
        ("flat", nan_of("actions")),
        ("flat", nan_of("joint_pos_target")),
        ("flat", lambda outputs: {key: value[:, :-1] for key, value in outputs.items()}),
        ("flat", broken),
        ("quadruped", nan_of("history_out")),
    ],
    ids=["action", "target", "size", "raises", "memory"],
)
def test_a_graph_that_fails_ends_in_the_damping_mode(deployed_policies, policy, change):
    session, contract = open_file(deployed_policies / policy / "policy_unitree_go2.onnx")
    network = network_of(session)
    loop = Loop(contract, lambda inputs: change(network(inputs)))
    loop.walk(at_once=True)
    assert is_damped(loop, loop.step(0.0, measured(loop)), "action_not_finite")


def test_the_contract_lists_the_faults(deployed_policies):
    _, contract = open_file(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    known = {fault for _, fault, _ in FAULTS.values()} | {"command_not_finite", "action_not_finite"}
    assert set(contracts.FAULTS) == known
    header = (files.ONBOARD / "policy_loop.hpp").read_text(encoding="utf-8")
    assert all(f'"{fault}"' in header for fault in contracts.FAULTS)
    assert contract.safety.stale_after == pytest.approx(0.06)


def test_a_loop_stands_before_it_walks(deployed_policies):
    loop = open_loop(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    lying = np.clip(loop.default_pos + 0.6 * np.resize([1.0, -1.0], 12), loop.lower, loop.upper)
    assert loop.step(0.0, measured(loop, joint_pos=lying)).mode == "damp"
    loop.walk()
    assert loop.step(0.0, measured(loop, joint_pos=lying)).mode == "damp"
    loop.stand()
    loop.walk()
    before = lying
    for step in range(100):
        command = loop.step(0.02 * step, measured(loop, 0.02 * step, joint_pos=before))
        assert command.mode == "stand"
        # half a cosine: no joint moves faster than pi/2 times its mean speed
        assert (
            np.abs(command.q - before).max() <= 0.5 * np.pi * np.abs(lying - loop.default_pos).max() * 0.02 / 2.0 + 1e-9
        )
        before = command.q
    np.testing.assert_allclose(before, loop.default_pos, atol=1e-3)
    assert loop.step(2.0, measured(loop, 2.0)).mode == "walk"
    loop.damp()
    assert loop.step(2.02, measured(loop, 2.02)).fault is None


def test_targets_and_commands_are_kept_within_their_limits(deployed_policies):
    session, contract = open_file(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    network, given = network_of(session), []

    def wild(inputs):
        given.append(dict(inputs))
        outputs = dict(network(inputs))
        return outputs | {"joint_pos_target": np.full((1, 12), 50.0, dtype=np.float32)}

    loop = Loop(contract, wild)
    loop.walk(at_once=True)
    command = loop.step(0.0, measured(loop), (9.0, -9.0, 0.1))
    np.testing.assert_array_equal(command.q, loop.upper)
    np.testing.assert_allclose(given[0]["velocity_commands"][0], [1.0, -1.0, 0.1], atol=1e-6)
    # the policy's action counts as its last action, not the limited one
    loop.step(0.0, measured(loop), (9.0, -9.0, 0.1))
    np.testing.assert_array_equal(given[1]["last_action"][0], network(given[0])["actions"][0])


def test_an_episode_begins_with_what_is_read_first(deployed_policies):
    """A recurrent loop that walks again remembers nothing, and its first step repeats."""
    loop = open_loop(deployed_policies / "quadruped" / "policy_unitree_go2.onnx")
    loop.walk(at_once=True)
    first = loop.step(0.0, measured(loop)).q
    for _ in range(5):
        later = loop.step(0.0, measured(loop, angular_velocity=[1.0, 0.0, 0.0])).q
    assert np.abs(later - first).max() > 1e-3
    loop.walk(at_once=True)
    np.testing.assert_array_equal(loop.step(0.0, measured(loop)).q, first)


ALONE = """
import sys
sys.modules.update(dict.fromkeys(("polypod", "torch", "onnx"), None))
from onboard.policy_loop import Sensors, open_loop
from onboard import ros2_control, unitree
loop = open_loop(sys.argv[1])
loop.walk(at_once=True)
pose = loop.default_pos
command = loop.step(0.0, Sensors(0.0, pose, 0.0 * pose, [1, 0, 0, 0], [0, 0, 0], [0, 0, 0]), (0.5, 0.0, 0.0))
print(command.mode, *command.q)
"""


def test_the_loop_runs_without_polypod(loop, deployed_policies, tmp_path, cli):
    source = deployed_policies / "flat" / "policy_unitree_go2.onnx"
    done = cli("deploy", "write", str(source), "--out", "robot")
    assert done.returncode == 0, done.stderr
    written = {path.relative_to(tmp_path / "robot").as_posix() for path in (tmp_path / "robot").rglob("*.*")}
    assert written == {path.removeprefix("robot/") for path in done.stdout.split()}
    assert written >= {"policy_unitree_go2.onnx", "contract.json", "contract.hpp", "onboard/unitree.py"}
    shown = cli("deploy", "show", str(source))
    assert shown.stdout == (tmp_path / "robot" / "contract.json").read_text(encoding="utf-8")
    command = [sys.executable, "-c", ALONE, "policy_unitree_go2.onnx"]
    alone = subprocess.run(command, cwd=tmp_path / "robot", capture_output=True, text=True, check=True, timeout=60)
    mode, *targets = alone.stdout.split()
    assert mode == "walk"
    wanted = loop.step(0.0, measured(loop), (0.5, 0.0, 0.0)).q
    np.testing.assert_allclose(np.array(targets, dtype=np.float64), wanted, atol=1e-6)


def low_state(contract, sensors):
    """A `LowState` of the maker's shape, its motors in the maker's order."""
    index = {name: at for at, name in enumerate(contract.joint_names)}
    motors = [
        SimpleNamespace(q=0.0, dq=0.0)
        if name is None
        else SimpleNamespace(q=float(sensors.joint_pos[index[name]]), dq=float(sensors.joint_vel[index[name]]))
        for name in contract.motors.joints
    ]
    imu = SimpleNamespace(quaternion=list(sensors.quaternion), gyroscope=list(sensors.angular_velocity))
    if contract.motors.interface == "unitree_sdk2":
        return SimpleNamespace(motor_state=motors, imu_state=imu)
    return SimpleNamespace(motorState=motors, imu=imu)


def low_cmd(contract):
    motors = [SimpleNamespace(mode=0, q=0.0) for _ in contract.motors.joints]
    is_new = contract.motors.interface == "unitree_sdk2"
    return SimpleNamespace(**{"motor_cmd" if is_new else "motorCmd": motors}), motors


@pytest.mark.parametrize(
    ("policy", "robot", "first"),
    [
        ("flat", "unitree_go2", {0: "FR_hip_joint", 3: "FL_hip_joint", 8: "RR_calf_joint", 9: "RL_hip_joint"}),
        ("flat", "unitree_a1", {0: "FR_hip_joint", 5: "FL_calf_joint", 6: "RR_hip_joint", 11: "RL_calf_joint"}),
        ("legged", "unitree_h1", {0: "right_hip_roll_joint", 6: "torso_joint", 8: "right_hip_yaw_joint", 9: None}),
        ("legged", "unitree_g1", {0: "left_hip_pitch_joint", 12: "waist_yaw_joint", 28: "right_wrist_yaw_joint"}),
    ],
)
def test_motors_are_in_the_makers_order(deployed_policies, policy, robot, first):
    loop = open_loop(deployed_policies / policy / f"policy_{robot}.onnx")
    contract = loop.contract
    assert {motor: contract.motors.joints[motor] for motor in first} == first
    given = deployed.readings(contract, np.random.default_rng(1))
    sensors = unitree.sensors_of(contract, low_state(contract, SimpleNamespace(**given)), 0.0)
    np.testing.assert_allclose(sensors.joint_pos, given["joint_pos"])
    np.testing.assert_allclose(sensors.joint_vel, given["joint_vel"])
    np.testing.assert_allclose(sensors.quaternion, given["quaternion"])
    loop.walk(at_once=True)
    command = loop.step(0.0, dataclasses.replace(sensors, linear_velocity=given["linear_velocity"]), (0.3, 0.0, 0.0))
    assert command.mode == "walk"
    message, motors = low_cmd(contract)
    unitree.write(contract, command, message)
    for motor, joint in first.items():
        if joint is None:
            assert vars(motors[motor]) == {"mode": 0, "q": 0.0}
            continue
        at = contract.joint_names.index(joint)
        found = {key.lower(): value for key, value in vars(motors[motor]).items()}
        wanted = {key: getattr(command, key)[at] for key in ("q", "dq", "kp", "kd", "tau")}
        assert found == pytest.approx(wanted | {"mode": contract.motors.modes[motor]})


def test_a_robot_whose_motors_are_unknown_is_told_so(deployed_policies):
    _, contract = open_file(deployed_policies / "legged" / "policy_cassie.onnx")
    with pytest.raises(ValueError, match="the contract names no motors of cassie in Unitree's order; pass motors"):
        unitree.sensors_of(contract, SimpleNamespace(), 0.0)


def messages(contract, sensors, time=0.0):
    """A `JointState` with its joints in reverse and one more, and an `Imu`."""
    stamp = SimpleNamespace(sec=int(time), nanosec=round(1e9 * (time - int(time))))
    header = SimpleNamespace(stamp=stamp)
    joints = SimpleNamespace(
        header=header,
        name=["camera", *reversed(contract.joint_names)],
        position=[9.0, *reversed(sensors.joint_pos)],
        velocity=[9.0, *reversed(sensors.joint_vel)],
    )
    w, x, y, z = sensors.quaternion
    rate = dict(zip("xyz", sensors.angular_velocity, strict=True))
    imu = SimpleNamespace(
        header=header,
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        orientation_covariance=[0.0] * 9,
        angular_velocity=SimpleNamespace(**rate),
    )
    return joints, imu


def test_ros_messages_are_read_by_name(deployed_policies):
    loop = open_loop(deployed_policies / "quadruped" / "policy_unitree_go2.onnx")
    contract = loop.contract
    given = SimpleNamespace(**deployed.readings(contract, np.random.default_rng(2)))
    joints, imu = messages(contract, given, 1.25)
    sensors = ros2_control.sensors_of(contract, joints, imu)
    assert sensors.time == pytest.approx(1.25)
    np.testing.assert_array_equal(sensors.joint_pos, given.joint_pos)
    np.testing.assert_array_equal(sensors.quaternion, given.quaternion)
    loop.walk(at_once=True)
    command = loop.step(1.25, sensors, (0.3, 0.0, 0.0))
    assert command.mode == "walk"
    values = ros2_control.interfaces(contract, command)
    assert len(values) == 60
    assert values["FL_calf_joint/position"] == command.q[2]
    assert values["FL_calf_joint/kp"] == 25.0
    efforts = ros2_control.efforts(contract, command, sensors)
    pull = 25.0 * (command.q[2] - given.joint_pos[2]) - 0.5 * given.joint_vel[2]
    assert efforts["FL_calf_joint/effort"] == pytest.approx(np.clip(pull, -23.5, 23.5))


def test_ros_messages_that_lack_something_end_in_the_damping_mode(deployed_policies):
    loop = open_loop(deployed_policies / "quadruped" / "policy_unitree_go2.onnx")
    contract = loop.contract
    given = SimpleNamespace(**deployed.readings(contract, np.random.default_rng(2)))
    for change in ("joint", "orientation", "velocity", "old"):
        joints, imu = messages(contract, given, 1.0)
        if change == "joint":
            joints.name[5] = "another"
        elif change == "orientation":
            imu.orientation_covariance[0] = -1.0
        elif change == "velocity":
            joints.velocity = []
        else:
            imu.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
        loop.walk(at_once=True)
        command = loop.step(1.0, ros2_control.sensors_of(contract, joints, imu))
        assert is_damped(loop, command, "sensor_stale" if change == "old" else "sensor_not_finite")


def unfolded():
    """The contract of a bare network that remembers, and the network as the loop calls it."""
    policy = bundled.checkpoint("quadruped")
    robot = interfaces(run_dir.read_manifest(policy), ["unitree_go2"])["unitree_go2"]
    said = {"name": "bare", "task": "x", "checkpoint_sha256": "0" * 64, "iteration": None, "polypod": "0"}
    document = contracts.of(robot, {}, said, is_folded=False, is_normalized=True, step_dt=0.02)
    return read_contract(contracts.text_of(document), "bare")


@pytest.fixture(scope="module")
def compiled(built_once, deployed_policies):
    """Compiles the driver for a contract; None without a compiler of C++."""
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")

    def program(name, contract):
        def build(folder):
            (folder / "contract.hpp").write_text(header_of(contract), encoding="utf-8")
            shutil.copytree(files.ONBOARD, folder / "onboard")
            flags = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{folder}"]
            subprocess.run([compiler, *flags, str(DRIVER), "-o", str(folder / "loop")], check=True, timeout=300)

        return built_once(f"cpp_{name}", build) / "loop"

    return program if compiler else None


def interface_of(contract: Contract, interface: str, plain: Sensors) -> Sensors:
    """The sensors as they come through an interface, whose messages hold float32 at Unitree."""
    if interface.startswith("unitree"):
        found = unitree.sensors_of(contract, low_state(contract, plain), plain.time)
    elif interface == "ros2_control":
        found = ros2_control.sensors_of(contract, *messages(contract, plain, plain.time))
    else:
        return plain
    return dataclasses.replace(found, linear_velocity=plain.linear_velocity, height_scan=plain.height_scan)


def motors_of(contract, interface, command, sensors):
    """All numbers that the motors get, as the driver prints them."""
    if interface.startswith("unitree"):
        message, motors = low_cmd(contract)
        unitree.write(contract, command, message)
        rows = [{key.lower(): value for key, value in vars(motor).items()} for motor in motors]
        return [row.get(key, 0.0) for row in rows for key in ("mode", "q", "dq", "kp", "kd", "tau")]
    if interface == "ros2_control":
        values = ros2_control.interfaces(contract, command)
        return [*values.values(), *ros2_control.efforts(contract, command, sensors).values()]
    return np.stack([command.q, command.dq, command.kp, command.kd, command.tau], axis=1).ravel().tolist()


def line_of(now, sensors, velocity, outputs):
    numbers = [now, sensors.time, *sensors.quaternion, *sensors.angular_velocity]
    lists = (sensors.joint_pos, sensors.joint_vel, sensors.linear_velocity, sensors.height_scan)
    for values in lists:
        values = [] if values is None else list(values)
        numbers += [len(values), *values]
    numbers += [*velocity, len(outputs), *outputs]
    return " ".join(f"{x:.17g}" for x in numbers)


@pytest.mark.parametrize(
    ("name", "interface"),
    [
        ("flat/unitree_go2", "plain"),
        ("flat/unitree_go2", "unitree_sdk2"),
        ("flat/unitree_go2", "ros2_control"),
        ("flat/unitree_a1", "unitree_legged_sdk"),
        ("legged/unitree_h1", "unitree_sdk2"),
        ("rough/unitree_go2", "plain"),
        ("quadruped/unitree_go2", "ros2_control"),
        ("bare", "plain"),
    ],
)
def test_the_loop_in_cpp_gives_the_same_numbers(deployed_policies, compiled, name, interface):
    """Inputs of the graph and the motors' commands.

    Over walking, standing, faults and commands beyond their ranges.
    """
    if compiled is None:
        pytest.skip("needs a compiler of C++: c++, g++ or clang++")
    if name == "bare":
        contract, graph = unfolded(), OnnxPolicy(deployed_policies / "quadruped" / "policy.onnx")

        def network(inputs):
            return {"actions": graph(obs=inputs["obs"])["actions"]}
    else:
        policy, robot = name.split("/")
        session, contract = open_file(deployed_policies / policy / f"policy_{robot}.onnx")
        network = network_of(session)
    given = []

    def watched(inputs):
        outputs = network(inputs)
        order = [*contract.outputs, *(output for output, _ in contract.states.values())]
        given.append(np.concatenate([np.ravel(outputs[key]) for key in order]))
        return outputs

    loop, random = Loop(contract, watched), np.random.default_rng(3)
    lines, wanted = [], []

    def step(now, velocity=(0.4, -0.2, 0.3), **changes):
        plain = Sensors(**({"time": now} | deployed.readings(contract, random) | changes))
        sensors = interface_of(contract, interface, plain)
        given.clear()
        command = loop.step(now, sensors, velocity)
        lines.append(line_of(now, plain, velocity, given[-1] if given else []))
        inputs = np.concatenate([np.ravel(value) for value in loop.inputs.values()]) if loop.inputs else np.zeros(0)
        motors = motors_of(contract, interface, command, sensors)
        wanted.append((command.mode, command.fault or "-", inputs, np.array(motors)))

    def tell(word):
        lines.append(word)
        {"stand": loop.stand, "walk": loop.walk, "damp": loop.damp}.get(word, lambda: loop.walk(at_once=True))()

    step(0.0)
    tell("stand")
    step(0.02)
    tell("walk")
    step(1.0)
    step(2.125)
    for tick in range(6):
        step(3.0 + tick, velocity=(9.0, -9.0, 0.1))
    upside_down, pose = [0.0, 1.0, 0.0, 0.0], loop.default_pos
    faults = [
        {"quaternion": upside_down},
        {"quaternion": [0.5, 0.0, 0.0, 0.0]},
        {"joint_pos": np.where(np.arange(len(pose)) == 1, np.nan, pose)},
        {"joint_pos": np.where(np.isfinite(loop.upper), loop.upper + 0.2, pose)},
        {"time": 9.5},
    ]
    if interface == "plain":
        faults += [{"joint_vel": pose[:-1]}, {"time": np.nan}]
        faults += [{"linear_velocity": None}] if "base_lin_vel" in contract.sensed else []
        faults += [{"height_scan": np.zeros(3)}, {"height_scan": None}] if contract.num_rays else []
    for at, changes in enumerate(faults):
        step(10.0, **changes)
        step(10.0)
        tell("walk")
        tell("stand" if at % 2 else "walk at once")
        step(10.0)
        tell("walk at once")
    step(11.0, velocity=(np.nan, 0.0, 0.0))
    tell("damp")
    step(12.0)
    program = compiled(name.replace("/", "_"), contract)
    done = subprocess.run(
        [program, interface], input="\n".join(lines) + "\n", capture_output=True, text=True, check=True, timeout=60
    )
    rows = done.stdout.splitlines()
    assert len(rows) == len(wanted)
    modes = set()
    for row, (mode, fault, inputs, motors) in zip(rows, wanted, strict=True):
        said, found_inputs, found_motors = row.split("|")
        assert said.split() == [mode, fault]
        np.testing.assert_allclose(np.array(found_inputs.split(), dtype=np.float64), inputs, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(np.array(found_motors.split(), dtype=np.float64), motors, rtol=1e-6, atol=1e-6)
        modes.add((mode, fault))
    assert {mode for mode, _ in modes} == {"damp", "stand", "walk"}
    found = {fault for _, fault in modes}
    assert found >= (
        {"sensor_size", "sensor_stale", "command_not_finite"} if interface == "plain" else {"sensor_stale"}
    )
    assert found >= {"tilt", "quaternion_not_unit", "sensor_not_finite", "joint_limit"}


def test_the_example_in_cpp_compiles(deployed_policies, tmp_path):
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("needs a compiler of C++: c++, g++ or clang++")
    files.write(deployed_policies / "rough" / "policy_unitree_go2.onnx", tmp_path)
    example = ROOT / "examples" / "deploy" / "policy_loop.cpp"
    flags = ["-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", f"-I{tmp_path}", f"-I{DRIVER.parent}"]
    subprocess.run([compiler, *flags, str(example)], check=True, timeout=300)


def test_a_header_keeps_names_that_are_no_plain_text(deployed_policies):
    """A name is data: it ends neither the literal nor the comment that it stands in."""
    path = deployed_policies / "flat" / "policy_unitree_go2.onnx"
    _, contract = open_file(path)
    evil = 'a"; system("x"); \\\n??/é'
    joints = (dataclasses.replace(contract.joints[0], name=evil), *contract.joints[1:])
    header = header_of(dataclasses.replace(contract, name=evil, robot=evil, joints=joints, motors=None))
    literal = '"a\\042; system(\\042x\\042); \\134\\012\\077\\077/\\303\\251"'
    assert f"{{{literal}, 0, " in header
    assert f"c.robot = {literal};" in header
    assert header.splitlines()[
        0
    ] == '// The contract of a"; system("x"); __??/_ with a"; system("x"); __??/_. Written by ' + (
        "`polypod deploy write`: do not edit."
    )
    assert contract.sha256 in header
