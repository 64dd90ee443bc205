"""`polypod.Simulation`: physics without a task, for any URDF."""

import numpy as np
import pytest

import polypod
from common import ROOT

URDF = ROOT / "tests/data/urdf"
ROBOT = "unitree_go2"
G = 9.81


def simulation(name, num_envs=1, **options):
    return polypod.Simulation(URDF / f"{name}.urdf", num_envs, **options)


def instruction_sets():
    found = []
    for simd in ["avx512", "avx2", "neon", "portable"]:
        try:
            polypod.Simulation(ROBOT, simd=simd)
        except polypod.ConfigError:
            continue
        found.append(simd)
    return found


def scatter(sim, seed=0):
    """Puts every env into a different state within the limits, by its number alone."""
    first = sim.nq - sim.num_joints
    for env in range(sim.num_envs):
        random = np.random.default_rng([seed, env])
        qpos = sim.default_qpos + 0.1 * random.standard_normal(sim.nq)
        qpos[first:] = np.clip(qpos[first:], *sim.joint_range.T)
        sim.set_state(qpos, 0.5 * random.standard_normal(sim.nv), env_ids=[env])


@pytest.mark.parametrize(("name", "fixed"), [("biped", False), ("biped", True), ("arm", True), ("box", False)])
def test_shapes(name, fixed):
    n, sim = 3, simulation(name, 3, fixed_base=fixed)
    joints, links = sim.num_joints, sim.num_links
    assert (sim.num_envs, len(sim.joint_names), len(sim.link_names), links) == (n, joints, links, joints + 1)
    assert (sim.nq, sim.nv) == ((joints, joints) if fixed else (joints + 7, joints + 6))
    if joints:
        sim.step(targets=0.1, kp=10.0, n=2)
    else:
        sim.step(n=2)
    assert sim.time == 2 * sim.dt
    expected = {
        "qpos": (n, sim.nq),
        "qvel": (n, sim.nv),
        "default_qpos": (sim.nq,),
        "joint_range": (joints, 2),
        "effort_limit": (joints,),
        "contact_forces": (n, links, 3),
        "joint_torque": (n, joints),
    }
    assert {name: getattr(sim, name).shape for name in expected} == expected
    assert {getattr(sim, name).dtype.name for name in expected} == {"float64"}
    assert [x.shape for x in sim.link_pose()] == [(n, links, 3), (n, links, 4)]
    assert [x.shape for x in sim.link_velocity()] == [(n, links, 3)] * 2
    assert sim.mass_matrix().shape == (n, sim.nv, sim.nv)
    assert sim.bias_force().shape == sim.forward_dynamics(np.zeros(joints)).shape == (n, sim.nv)
    assert sim.inverse_dynamics(np.zeros((n, sim.nv))).shape == (n, sim.nv)
    assert sim.jacobian(links - 1).shape == (n, 6, sim.nv)
    assert [x.shape for x in (*sim.energy(), sim.center_of_mass(), *sim.momentum())] == [(n,)] * 2 + [(n, 3)] * 3


@pytest.mark.parametrize(
    ("options", "exception", "message"),
    [
        ({"robot": "unitree_go3"}, polypod.UnknownNameError, "unitree_go2"),
        ({"robot": "nowhere.urdf"}, polypod.RobotError, "nowhere.urdf"),
        ({"engine": "bullet"}, polypod.ConfigError, "articulated"),
        ({"engine": "avian", "dtype": "float64"}, polypod.ConfigError, "articulated"),
        ({"ground": "sea"}, polypod.ConfigError, "plane"),
        ({"ground_normal": (0, 0, 0)}, polypod.ConfigError, "ground_normal"),
        ({"dtype": "float16"}, polypod.ConfigError, "float64"),
        ({"simd": "mmx"}, polypod.ConfigError, "portable"),
        ({"num_envs": 0}, polypod.ConfigError, "num_envs"),
        ({"num_envs": -1}, polypod.ConfigError, "num_envs"),
        ({"dt": 0.0}, polypod.ConfigError, "dt"),
        ({"dt": np.nan}, polypod.ConfigError, "dt"),
        ({"gravity": (0, 0, np.inf)}, polypod.ConfigError, "gravity"),
        ({"friction": -0.1}, polypod.ConfigError, "friction"),
        ({"friction": (1, 1, 1)}, ValueError, r"friction: shape \(3,\)"),
        ({"restitution": 1.5}, polypod.ConfigError, "restitution"),
        ({"armature": [0.1, 0.2]}, polypod.ConfigError, "armature"),
        ({"threads": 0}, polypod.ConfigError, "threads"),
        ({"solver_iterations": 0}, polypod.ConfigError, "solver_iterations"),
        ({"avian_substeps": 0}, polypod.ConfigError, "avian_substeps"),
    ],
    ids=lambda value: repr(value) if isinstance(value, dict) else "",
)
def test_bad_options(options, exception, message):
    with pytest.raises(exception, match=message):
        polypod.Simulation(**{"robot": ROBOT, **options})


@pytest.mark.parametrize(
    ("call", "exception", "message"),
    [
        (
            lambda s: s.step(targets=np.zeros(5)),
            ValueError,
            r"targets: shape \(5,\); pass a number or \(6,\) or \(2, 6\)",
        ),
        (lambda s: s.step(targets=np.zeros((6, 2))), ValueError, r"\(2, 6\)"),
        (lambda s: s.step(targets=0.0, torque=0.0), polypod.ConfigError, "together with targets"),
        (lambda s: s.step(torque=[0, 0, np.nan, 0, 0, 0]), polypod.ConfigError, "torque: NaN"),
        (lambda s: s.step(targets="left"), TypeError, "targets"),
        (lambda s: s.step(targets=0.0, kp=-1.0), polypod.ConfigError, "kp"),
        (lambda s: s.step(targets=0.0, effort_limit=np.nan), polypod.ConfigError, "effort_limit"),
        (lambda s: s.step(n=0), polypod.ConfigError, "n: 0 steps"),
        (lambda s: s.set_state(qpos=np.zeros(12)), ValueError, r"qpos: shape \(12,\)"),
        (lambda s: s.set_state(qpos=np.zeros(13)), polypod.ConfigError, "quaternion of row 0"),
        (lambda s: s.set_state(qvel=np.full((2, 12), np.inf)), polypod.ConfigError, "qvel: inf at row 0, column 0"),
        (lambda s: s.set_state(qvel=np.zeros((2, 12)), env_ids=[1]), ValueError, r"\(1, 12\)"),
        (lambda s: s.set_state(qvel=np.zeros(12), env_ids=[2]), polypod.ConfigError, "no env 2"),
        (lambda s: s.set_state(qvel=np.zeros(12), env_ids=[-1]), ValueError, "no env -1"),
        (lambda s: s.set_state(qvel=np.zeros(12), env_ids=[True, False]), TypeError, "flatnonzero"),
        (lambda s: s.jacobian("left_shin"), polypod.UnknownNameError, "left_"),
        (lambda s: s.jacobian(7), polypod.ConfigError, "0 to 6"),
        (lambda s: s.jacobian(1.5), TypeError, "name or an index"),
        (lambda s: s.set_mass("torso", 0.0), polypod.ConfigError, "positive"),
        (lambda s: s.set_mass("torso", [1, 2, 3]), ValueError, r"\(2,\)"),
        (lambda s: s.set_com("torso", [0, 0]), ValueError, r"\(3,\)"),
        (lambda s: s.set_inertia("torso", [1, 1, 3, 0, 0, 0]), polypod.ConfigError, "no rigid body"),
        (lambda s: s.set_inertia("torso", [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]), ValueError, "not symmetric"),
        (lambda s: s.set_friction(-1.0), polypod.ConfigError, "friction"),
        (lambda s: s.set_armature(-1.0), polypod.ConfigError, "armature"),
        (lambda s: s.forward_dynamics(np.zeros(7)), ValueError, r"\(12,\)"),
        (lambda s: s.restore(b"nothing"), polypod.ConfigError, "snapshot"),
        (lambda s: s.restore(simulation("biped", 3).snapshot()), polypod.ConfigError, "another simulation"),
        (lambda s: s.restore(simulation("biped", 2, dt=0.001).snapshot()), polypod.ConfigError, "another simulation"),
    ],
)
def test_bad_calls_change_nothing(call, exception, message):
    sim = simulation("biped", 2)
    before = sim.snapshot()
    with pytest.raises(exception, match=message):
        call(sim)
    assert sim.snapshot() == before


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_state_round_trip(dtype):
    sim = simulation("biped", 5, dtype=dtype)
    scatter(sim)
    sim.step(targets=0.0, kp=100.0, kd=5.0, n=7)
    qpos, qvel = sim.qpos, sim.qvel
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, atol=1e-6)
    other = simulation("biped", 5, dtype=dtype)
    other.set_state(qpos, qvel)
    np.testing.assert_array_equal(other.qpos, qpos)
    np.testing.assert_array_equal(other.qvel, qvel)
    # one without the other
    other.set_state(qvel=np.zeros(sim.nv))
    np.testing.assert_array_equal(other.qpos, qpos)
    assert not other.qvel.any()


def test_quaternions_are_normalised():
    sim = simulation("box", dtype="float64")
    sim.set_state([0, 0, 1, 0, 0, 3, 4])
    np.testing.assert_allclose(sim.qpos[0, 3:], [0, 0, 0.6, 0.8], atol=1e-15)


def test_env_ids_choose_the_envs():
    sim = simulation("biped", 20)
    before = sim.qpos
    rows = np.tile(sim.default_qpos, (2, 1))
    rows[:, 2] = [5.0, 6.0]
    sim.set_state(rows, env_ids=np.array([17, 3]))
    after = sim.qpos
    assert (after[17, 2], after[3, 2]) == (5.0, 6.0)
    others = [env for env in range(20) if env not in (3, 17)]
    np.testing.assert_array_equal(after[others], before[others])
    sim.set_gains(kp=7.0, env_ids=[4])
    sim.step(targets=0.1)
    moved = np.flatnonzero(np.abs(sim.joint_torque).max(axis=1) > 0.0)
    assert moved.tolist() == [4]


def test_parameters_differ_from_env_to_env():
    sim = simulation("arm", 4, fixed_base=True, dtype="float64", gravity=(0, 0, 0))
    tool = sim.link_names.index("tool")
    sim.set_mass("tool", [0.5, 1.0, 0.5, 2.0])
    slider = sim.joint_names.index("slider")
    diagonal = sim.mass_matrix()[:, slider, slider]
    np.testing.assert_allclose(diagonal, [0.5, 1.0, 0.5, 2.0], rtol=1e-12)
    sim.set_com(tool, [0.1, 0.0, 0.0], env_ids=[2])
    sim.set_armature(0.3, env_ids=[1])
    np.testing.assert_allclose(sim.mass_matrix()[:, slider, slider], [0.5, 1.3, 0.5, 2.0], rtol=1e-12)
    sim.step(torque=[0, 0, 1.0])
    speed = sim.qvel[:, slider]
    assert len({round(v, 12) for v in speed}) == 4, speed
    assert sim.total_mass == pytest.approx(14.0)


def test_mass_scales_the_inertia_and_set_inertia_replaces_it():
    sim = simulation("box", 2, ground=None, dtype="float64")
    sim.set_mass(0, 4.0, env_ids=[1])
    np.testing.assert_allclose(np.diag(sim.mass_matrix()[1])[3:], [0.024, 0.04, 0.06], rtol=1e-12)
    np.testing.assert_allclose(np.diag(sim.mass_matrix()[0])[3:], [0.012, 0.02, 0.03], rtol=1e-12)
    inertia = np.array([[0.02, 0.001, 0.002], [0.001, 0.03, 0.003], [0.002, 0.003, 0.04]])
    sim.set_inertia(0, inertia)
    np.testing.assert_allclose(sim.mass_matrix()[:, 3:, 3:], [inertia] * 2, rtol=1e-12)
    sim.set_inertia(0, [0.03, 0.02, 0.03, 0.0, 0.0, 0.001], env_ids=[1])
    np.testing.assert_allclose(sim.mass_matrix()[0, 3:, 3:], inertia, rtol=1e-12)
    assert sim.mass_matrix()[1, 4, 5] == pytest.approx(0.001)


def test_com_and_inertia_are_in_the_frame_of_the_urdf():
    # the upper arm's frame is turned against the base's; its URDF inertia is given in axes that are
    # turned once more
    sim = simulation("arm", fixed_base=True, dtype="float64")
    sim.set_state([0.2, 0.7, -0.3])
    before = sim.mass_matrix()
    sim.set_com("upper_arm", [0.15, 0.02, -0.01])
    np.testing.assert_allclose(sim.mass_matrix(), before, rtol=1e-12)
    r, p, y = 0.2, 0.3, -0.1
    rx = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    ry = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    rz = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    turn = rz @ ry @ rx
    given = np.array([[0.005, 0.001, -0.0005], [0.001, 0.02, 0.0007], [-0.0005, 0.0007, 0.021]])
    sim.set_inertia("upper_arm", turn @ given @ turn.T)
    np.testing.assert_allclose(sim.mass_matrix(), before, rtol=1e-9)
    sim.set_inertia("upper_arm", given)
    assert np.abs(sim.mass_matrix() - before).max() > 1e-5


def test_given_gains_and_limits_are_kept():
    def make():
        sim = simulation("biped", 3)
        scatter(sim)
        return sim

    gains = {"kp": np.linspace(50, 100, 6), "kd": 4.0, "effort_limit": np.full((3, 6), 15.0)}
    kept, given, set_once = make(), make(), make()
    set_once.set_gains(kp=gains["kp"], kd=gains["kd"])
    set_once.step(targets=0.1, effort_limit=15.0, n=5)
    kept.step(targets=0.1, **gains, n=5)
    given.step(targets=0.1, **gains, n=5)
    for sim in (kept, given, set_once):
        # gains play no part in torques, but are not forgotten for them
        sim.step(torque=1.0, n=3)
        np.testing.assert_array_equal(sim.joint_torque, 1.0)
    kept.step(targets=-0.1, n=5)
    given.step(targets=-0.1, **gains, n=5)
    set_once.step(targets=-0.1, n=5)
    np.testing.assert_array_equal(kept.qpos, given.qpos)
    np.testing.assert_array_equal(kept.qpos, set_once.qpos)
    assert (np.abs(kept.qpos - make().qpos) > 0.01).any()


def test_restore_goes_on_as_if_nothing_happened():
    def drive(sim, steps):
        for step in steps:
            sim.step(targets=0.2 * np.sin(0.3 * step + np.arange(6)), n=2)

    sim, other = simulation("biped", 11, threads=1), simulation("biped", 11, threads=3)
    scatter(sim)
    sim.set_mass("torso", np.linspace(10, 30, 11))
    sim.set_friction(np.linspace(0.2, 1.0, 11))
    sim.set_gains(kp=200.0, kd=5.0)
    drive(sim, range(40))
    assert sim.contact_forces.any(), "contacts must have been part of it"
    state = sim.snapshot()
    other.restore(state)
    assert other.time == sim.time
    for name in ("qpos", "qvel", "contact_forces", "joint_torque"):
        np.testing.assert_array_equal(getattr(other, name), getattr(sim, name))
    drive(sim, range(40, 80))
    drive(other, range(40, 80))
    assert sim.snapshot() == other.snapshot() != state
    sim.restore(state)
    drive(sim, range(40, 80))
    assert sim.snapshot() == other.snapshot()
    damaged = bytearray(state)
    damaged[len(state) // 2] ^= 1
    with pytest.raises(polypod.ConfigError, match="damaged"):
        sim.restore(bytes(damaged))


def rollout(robot, num_envs, **options):
    sim = polypod.Simulation(robot, num_envs, **options)
    scatter(sim)
    for step in range(60):
        sim.step(targets=sim.default_qpos[7:] + 0.2 * np.sin(0.2 * step), kp=60.0, kd=2.0, n=2)
    assert np.isfinite(sim.qpos).all()
    return sim.qpos.tobytes(), sim.qvel.tobytes(), sim.contact_forces.tobytes(), sim.link_pose()[1].tobytes()


def test_threads_and_instruction_sets_do_not_change_bits():
    robot = URDF / "biped.urdf"
    # more than one pack per thread, and the last one is not full
    reference = rollout(robot, 137, threads=1)
    assert rollout(robot, 137, threads=4) == reference
    for simd in instruction_sets():
        assert rollout(robot, 137, simd=simd) == reference, simd
    assert rollout(ROBOT, 9, simd="portable", threads=2) == rollout(ROBOT, 9, threads=1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_envs_do_not_depend_on_their_neighbours(dtype):
    many = simulation("biped", 21, dtype=dtype)
    scatter(many)
    alone, elsewhere = simulation("biped", 1, dtype=dtype), simulation("biped", 6, dtype=dtype)
    alone.set_state(many.qpos[18], many.qvel[18])
    elsewhere.set_state(many.qpos[[18] * 6], many.qvel[[18] * 6])
    # a neighbour that diverges harms only itself
    elsewhere.set_state(qvel=np.full(elsewhere.nv, 1e30), env_ids=[0])
    for sim in (many, alone, elsewhere):
        sim.step(targets=0.1, kp=80.0, kd=3.0, n=150)
    assert not np.isfinite(elsewhere.qpos[0]).all()
    for other in (alone.qpos[0], elsewhere.qpos[4]):
        assert other.tobytes() == many.qpos[18].tobytes()


def test_free_fall_without_ground():
    n, sim = 400, simulation("biped", ground=None, dtype="float64")
    assert not sim.default_qpos[:3].any()
    sim.set_state(qvel=[1, 2, 3] + [0] * 9)
    sim.step(n=n)
    t = n * sim.dt
    np.testing.assert_allclose(sim.qvel[0, :3], [1, 2, 3 - G * t], rtol=1e-10)
    # the sum that semi-implicit Euler steps make
    height = 3 * t - 0.5 * G * t * (t + sim.dt)
    np.testing.assert_allclose(sim.qpos[0, :3], [t, 2 * t, height], rtol=1e-10)
    assert not sim.contact_forces.any()


def test_a_block_rests_slides_and_sticks_on_a_slope():
    angle = 0.4
    normal = (-3 * np.sin(angle), 0, 3 * np.cos(angle))
    sim = simulation("box", 3, ground_normal=normal, dtype="float64", solver_iterations=8)
    lying = [0, 0, 0, np.cos(angle / 2), 0, -np.sin(angle / 2), 0]
    lying[:3] = 0.05 * np.array(normal) / 3
    sim.set_state(lying)
    sim.set_friction([0.0, 0.2, 1.0])
    sim.step(n=200)
    speed = sim.qvel[:, :3] @ [-np.cos(angle), 0, -np.sin(angle)]
    expected = [G * (np.sin(angle) - mu * np.cos(angle)) * sim.time for mu in (0.0, 0.2)]
    # contacts give way by 1e-3 / m to the impulse of a step, here on each of four corners: the
    # ground has not yet stopped the last of the fall, nor have 8 sweeps shared the load among the
    # corners but for a small residue
    sinking = 1e-3 * G * np.cos(angle) * sim.dt / 4
    np.testing.assert_allclose(speed[:2], expected, rtol=1e-6, atol=0.2 * sinking)
    assert abs(speed[2]) < 1e-6
    force = sim.contact_forces[2, 0]
    np.testing.assert_allclose(force, [0, 0, sim.total_mass * G], atol=1e-3)


@pytest.mark.parametrize("direction", [0.0, 0.6, 2.0, -1.1])
def test_friction_acts_against_the_slip(direction):
    sim = simulation("box", friction=(0.4, 0.3), dtype="float64")
    toward = np.array([np.cos(direction), np.sin(direction), 0.0])
    sim.set_state(qvel=[*(3 * toward), 0, 0, 0])
    sim.step(n=100)
    np.testing.assert_allclose(sim.qvel[0, :3], (3 - 0.3 * G * sim.time) * toward, atol=1e-4)


def test_restitution():
    sim = simulation("box", restitution=0.5, dt=0.001, dtype="float64")
    sim.set_state(np.array([0, 0, 1.05, 1, 0, 0, 0]))
    sim.step(n=500)
    assert sim.qvel[0, 2] == pytest.approx(0.5 * np.sqrt(2 * G * 1.0) - G * (0.5 - np.sqrt(2 / G)), rel=0.02)


def test_a_biped_stands():
    # with stiff legs the load can be shared among eight corners in many ways: more sweeps than
    # usual to settle it
    sim = simulation("biped", 2, solver_iterations=32)
    sim.step(targets=0.0, kp=400.0, kd=10.0, n=600)
    assert sim.default_qpos[2] == pytest.approx(1.06)
    np.testing.assert_allclose(sim.qpos[:, 2], 1.06, atol=0.01)
    forces = sim.contact_forces
    np.testing.assert_allclose(forces.sum(axis=1), [[0, 0, sim.total_mass * G]] * 2, atol=0.01)
    touching = {sim.link_names[link] for link in np.flatnonzero(forces[0, :, 2] > 1.0)}
    assert touching == {"left_foot", "right_foot"}


def test_wheels_roll():
    sim = simulation("cart", dt=0.002)
    assert sim.default_qpos[2] == pytest.approx(0.1)
    assert np.isinf(sim.joint_range).all()
    sim.step(torque=0.2, n=1000)
    speed, spin = sim.qvel[0, 0], sim.qvel[0, 6:]
    # four wheels of 0.1 m with an inertia of 0.005 kg m^2 under 12 kg
    assert speed == pytest.approx(4 * 0.2 / 0.1 / (12 + 4 * 0.005 / 0.01) * sim.time, rel=0.02)
    np.testing.assert_allclose(spin, speed / 0.1, rtol=0.01)
    assert abs(sim.qpos[0, 1]) < 1e-3


def test_prismatic_joints_and_a_fixed_base():
    sim = simulation("arm", 2, fixed_base=True, dtype="float64")
    moved = sim.total_mass - 10.0
    np.testing.assert_allclose(sim.bias_force()[:, 0], moved * G, rtol=1e-12)
    assert sim.default_qpos.tolist() == [0, 0, 0]
    sim.step(torque=[moved * G, 0, 0], effort_limit=np.inf, n=200)
    (kinetic, potential) = sim.energy()
    assert np.isfinite(kinetic).all()
    assert np.isfinite(potential).all()
    base_position, base_quaternion = (pose[:, 0] for pose in sim.link_pose())
    assert not base_position.any()
    np.testing.assert_array_equal(base_quaternion, [[1, 0, 0, 0]] * 2)
    # the lift carries everything: its own acceleration is force over mass once the other joints
    # hold still
    sim.set_state([0, 0, 0], [0, 0, 0])
    qacc = sim.forward_dynamics(sim.inverse_dynamics([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(qacc, [[1, 0, 0]] * 2, atol=1e-12)


def test_energy_is_kept_by_a_passive_arm():
    def drift(dt):
        sim = simulation("arm", fixed_base=True, dtype="float64", dt=dt)
        sim.set_state([0, 0.5, 0.1], [0.5, 2.0, -0.3])
        before = sum(sim.energy())[0]
        sim.step(n=round(0.5 / dt))
        kinetic, potential = sim.energy()
        assert kinetic[0] > 10.0, "it has fallen"
        return abs(kinetic[0] + potential[0] - before) / kinetic[0]

    # the integrator is of first order
    assert drift(2.5e-4) < 0.3 * drift(1e-3) < 1e-2


def test_poses_velocities_and_jacobians_agree():
    sim = simulation("biped", 2, dtype="float64", ground=None)
    scatter(sim)
    # away from the joints' limits, which would push
    sim.set_state(sim.qpos + np.repeat([0.0, 0.4], [7, 6]))
    point = np.array([0.03, -0.1, 0.2])
    for link in sim.link_names:
        at = sim.link_names.index(link)
        velocity = np.einsum("nij,nj->ni", sim.jacobian(link), sim.qvel)
        linear, angular = sim.link_velocity()
        np.testing.assert_allclose(velocity[:, :3], linear[:, at], atol=1e-12)
        np.testing.assert_allclose(velocity[:, 3:], angular[:, at], atol=1e-12)
        # a point of the link is carried along by its rotation
        _, quaternion = (pose[:, at] for pose in sim.link_pose())
        arm = np.array([rotate(q, point) for q in quaternion])
        carried = np.einsum("nij,nj->ni", sim.jacobian(at, point), sim.qvel)
        np.testing.assert_allclose(carried[:, :3], linear[:, at] + np.cross(angular[:, at], arm), atol=1e-12)
    dt = 1e-6
    before = sim.link_pose()[0]
    velocity = sim.link_velocity()[0]
    small = simulation("biped", 2, dtype="float64", ground=None, dt=dt)
    small.set_state(sim.qpos, sim.qvel)
    small.step()
    np.testing.assert_allclose((small.link_pose()[0] - before) / dt, velocity, atol=1e-3)


def rotate(quaternion, vector):
    w, u = quaternion[0], quaternion[1:]
    return vector + 2 * np.cross(u, np.cross(u, vector) + w * vector)


def test_link_frames_are_those_of_the_urdf():
    sim = simulation("arm", fixed_base=True, dtype="float64")
    _, quaternion = sim.link_pose()
    # rpy="0.4 -0.7 1.1", about fixed x, then y, then z
    half = np.array([0.4, -0.7, 1.1]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    expected = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    np.testing.assert_allclose(quaternion[0, sim.link_names.index("upper_arm")], expected, atol=1e-12)


def test_momentum_and_mass_matrix_agree():
    sim = simulation("biped", dtype="float64", ground=None)
    scatter(sim)
    linear, _ = sim.momentum()
    np.testing.assert_allclose((sim.mass_matrix() @ sim.qvel[0])[0, :3], linear[0], atol=1e-10)
    kinetic, potential = sim.energy()
    assert kinetic[0] == pytest.approx(0.5 * sim.qvel[0] @ sim.mass_matrix()[0] @ sim.qvel[0])
    assert potential[0] == pytest.approx(sim.total_mass * G * sim.center_of_mass()[0, 2])
    force = np.random.default_rng(3).standard_normal(sim.nv)
    qacc = sim.forward_dynamics(force)
    np.testing.assert_allclose((sim.mass_matrix() @ qacc[0])[0] + sim.bias_force()[0], force, atol=1e-9)
    np.testing.assert_allclose(sim.inverse_dynamics(qacc)[0], force, atol=1e-9)
    # joint torques alone leave the base unforced
    joints = sim.forward_dynamics(force[6:])
    np.testing.assert_allclose(sim.inverse_dynamics(joints)[0], [*np.zeros(6), *force[6:]], atol=1e-9)


def test_explicit_targets_are_torques():
    options = {"dtype": "float64", "ground": None}
    by_targets, by_torque = simulation("biped", 3, **options), simulation("biped", 3, **options)
    scatter(by_targets)
    scatter(by_torque)
    limit = 20.0
    for _ in range(20):
        wanted = 300.0 * (0.2 - by_torque.qpos[:, 7:]) - 5.0 * by_torque.qvel[:, 6:]
        by_torque.step(torque=np.clip(wanted, -limit, limit), effort_limit=limit)
        by_targets.step(targets=0.2, kp=300.0, kd=5.0, effort_limit=limit, implicit=False)
        np.testing.assert_allclose(by_targets.joint_torque, np.clip(wanted, -limit, limit), atol=1e-9)
    assert (np.abs(by_targets.joint_torque) == limit).any()
    np.testing.assert_allclose(by_targets.qpos, by_torque.qpos, atol=1e-10)


def test_torque_is_limited():
    sim = simulation("biped")
    sim.step(torque=1e4)
    np.testing.assert_array_equal(sim.joint_torque[0], sim.effort_limit)
    sim.step(torque=-1e4, effort_limit=3.0)
    np.testing.assert_array_equal(sim.joint_torque[0], -3.0)
    sim.step(torque=500.0, effort_limit=np.inf)
    np.testing.assert_array_equal(sim.joint_torque[0], 500.0)


def test_implicit_and_explicit_gains_agree_for_small_steps():
    def difference(dt):
        ends = []
        for implicit in (True, False):
            sim = simulation("arm", fixed_base=True, dtype="float64", dt=dt)
            sim.step(targets=[0.1, 0.5, -0.1], kp=[800, 60, 80], kd=[40, 4, 6], implicit=implicit, n=round(0.2 / dt))
            ends.append(sim.qpos)
        return np.abs(ends[0] - ends[1]).max()

    coarse, fine = difference(1e-3), difference(2.5e-4)
    assert coarse > 1e-6, "they differ"
    assert fine < 0.3 * coarse


def test_single_and_double_precision_agree():
    single, double = (polypod.Simulation(ROBOT, 2, dtype=dtype) for dtype in ("float32", np.float64))
    targets = single.default_qpos[7:]
    for sim in (single, double):
        sim.step(targets=targets + 0.1, n=100)
    # 0.5 s with landing: rounding of 1e-7 grows through the contacts
    np.testing.assert_allclose(single.qpos, double.qpos, atol=2e-4)
    np.testing.assert_allclose(single.mass_matrix(), double.mass_matrix(), atol=2e-4)
    assert np.abs(single.qpos - double.qpos).max() > 0.0


def test_library_robots_bring_their_actuators():
    sim = polypod.Simulation(ROBOT)
    standing = sim.default_qpos[2]
    sim.step(targets=sim.default_qpos[7:], n=400)
    assert 0.7 * standing < sim.qpos[0, 2] < standing
    assert sim.effort_limit.min() > 0.0
    weight = sim.total_mass * G
    assert sim.contact_forces[0, :, 2].sum() == pytest.approx(weight, rel=0.02)
    armature = (
        polypod.Simulation(ROBOT, armature=1.0).mass_matrix() - polypod.Simulation(ROBOT, armature=0.0).mass_matrix()
    )
    np.testing.assert_allclose(np.diag(armature[0]), [0] * 6 + [1] * 12, atol=1e-12)


def test_links_of_a_robot_may_collide():
    def force(self_collision):
        sim = simulation("biped", self_collision=self_collision, ground=None, gravity=(0, 0, 0), fixed_base=True)
        # the left shank folds up against the thigh until the foot meets the torso
        sim.step(targets=[1.4, 2.4, -0.9, 0, 0, 0], kp=200.0, kd=10.0, n=400)
        return np.linalg.norm(sim.contact_forces[0], axis=1), sim.qpos[0]

    off, free = force(None)
    on, stopped = force(True)
    assert not off.any()
    assert on.any()
    assert np.abs(stopped - free).max() > 0.02


def chain(joints):
    """A hanging chain whose joints turn about x and y in turn."""
    link = (
        '<link name="l{0}"><inertial><origin xyz="0 0 -0.05"/><mass value="0.1"/>'
        '<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="2e-5"/></inertial></link>'
    )
    joint = (
        '<joint name="j{0}" type="revolute"><origin xyz="0 0 -0.1"/><parent link="l{1}"/><child link="l{0}"/>'
        '<axis xyz="{2}"/><limit lower="-3" upper="3" effort="50" velocity="50"/></joint>'
    )
    parts = [link.format(0)]
    for j in range(1, joints + 1):
        parts += [joint.format(j, j - 1, "1 0 0" if j % 2 else "0 1 0"), link.format(j)]
    return f'<robot name="chain">{"".join(parts)}</robot>'


def test_a_chain_of_64_joints(tmp_path):
    path = tmp_path / "chain.urdf"
    path.write_text(chain(64))
    sim = polypod.Simulation(path, 3, fixed_base=True, ground=None, dt=0.001)
    assert sim.num_joints == 64
    sim.set_state(0.05 * np.random.default_rng(0).standard_normal((3, 64)))
    before = sum(sim.energy())
    sim.step(targets=0.0, kp=0.0, kd=0.5, n=500)
    assert np.isfinite(sim.qpos).all()
    assert (sum(sim.energy()) < before).all()
    path.write_text(chain(65))
    with pytest.raises(polypod.RobotError, match="number 65 in a chain of moving joints"):
        polypod.Simulation(path)


def test_warnings_of_the_loader(tmp_path):
    path = tmp_path / "mesh.urdf"
    path.write_text(
        '<robot name="mesh"><link name="base"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
        '<collision><geometry><mesh filename="package://p/base.stl"/></geometry></collision></link></robot>'
    )
    with pytest.warns(UserWarning, match=r"mesh\.urdf: .*mesh"):
        sim = polypod.Simulation(path)
    assert len(sim.warnings) == 1
    assert simulation("biped").warnings == []


def test_ground_gap_of_a_standing_robot():
    sim = polypod.Simulation("unitree_go2", 2)
    pose = sim.default_qpos
    sim.set_state(pose)
    start = sim.ground_gap()
    sim.step(targets=pose[7:], n=400)
    gap = sim.ground_gap()
    assert start.shape == (2, sim.num_links)
    feet = np.sort(gap, axis=1)[:, :4]
    np.testing.assert_allclose(feet, 0.0, atol=1e-3)
    assert (gap[:, 0] > 0.1).all()
    assert np.isinf(polypod.Simulation("unitree_go2", ground=None).ground_gap()).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_contacts_that_nothing_can_satisfy_stay_finite(dtype):
    """Legs of a robot whose base is nailed to the ground's height reach a metre into it."""
    sim = polypod.Simulation(URDF / "biped.urdf", 4, fixed_base=True, dtype=dtype)
    sim.set_state(0.1 * np.random.default_rng(0).standard_normal((4, sim.nq)) * [[0.0], [1.0], [1.0], [1.0]])
    for _ in range(40):
        sim.step(targets=0.0, kp=100.0, kd=2.0, n=25)
        assert np.isfinite(sim.qpos).all()
        assert np.isfinite(sim.contact_forces).all()
        assert np.abs(sim.qvel).max() < 1e3
