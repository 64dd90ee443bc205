"""States, parameters and forces that are set at run time do what they say, in the named envs alone.

Bits and resume hold with them.
"""

import numpy as np
import pytest

import polypod
from polypod import ConfigError, UnknownNameError

TASK = "velocity_flat"
ROBOTS = ["unitree_go2", "anymal_c"]
FREE = {
    "events": {"push_robot": {"enabled": False}},
    "sim": {"gravity": [0.0, 0.0, 0.0]},
    "terminations": {"base_contact": None},
}


def batch(num_envs=8, engine="articulated", threads=1, robots=ROBOTS, **options):
    overrides = {"physics.engine": engine, **options.pop("overrides", {})}
    env = polypod.make(TASK, num_envs, robots=robots, seed=3, threads=threads, overrides=overrides, **options)
    env.reset()
    return env


def drawn(env, step):
    rng = np.random.default_rng(step)
    return rng.normal(0.0, 0.5, (env.num_envs, env.sim.num_actions)).astype(np.float32)


def walk(env, steps, start=0):
    for step in range(start, start + steps):
        env.step(drawn(env, step))


def everything(env, rows=slice(None)):
    fields = ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "joint_pos", "joint_vel", "joint_acc")
    more = ("joint_effort", "contact_forces", "feet_pos", "feet_air_time", "feet_contact_time", "command")
    found = [env.sim.state(field)[rows] for field in (*fields, *more)]
    return [array.tobytes() for array in (*found, env.sim.observation[rows], env.sim.reward[rows])]


def some_state(n, width, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4)) * [0.2, 0.1, 0.1, 1.0] + [1.0, 0.0, 0.0, 0.0]
    return {
        "base_pos": rng.uniform([-0.3, -0.3, 0.8], [0.3, 0.3, 1.2], (n, 3)),
        "base_quat": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        "base_lin_vel": rng.uniform(-1.0, 1.0, (n, 3)),
        "base_ang_vel": rng.uniform(-1.0, 1.0, (n, 3)),
        "joint_vel": rng.uniform(-1.0, 1.0, (n, width)),
    }


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_what_is_set_is_the_state(engine):
    env = batch(engine=engine)
    walk(env, 5)
    rows = [1, 6, 3]
    before = {name: env.sim.state(name) for name in ("joint_pos", "command", "last_action", "feet_pos")}
    values = some_state(3, env.sim.num_actions)
    values["joint_pos"] = env.state.default_joint_pos[rows] + 0.05
    env.sim.set_state(rows, **values)
    for name, wanted in values.items():
        np.testing.assert_allclose(env.sim.state(name)[rows], wanted, atol=2e-6, err_msg=name)
    for name in ("joint_acc", "joint_effort", "contact_forces", "feet_air_time", "feet_contact_time"):
        assert not env.sim.state(name)[rows].any(), name
    for name in ("command", "last_action"):
        np.testing.assert_array_equal(env.sim.state(name), before[name])
    assert (np.abs(env.sim.state("feet_pos") - before["feet_pos"])[rows] > 1e-3).any(axis=1).all()
    gravity = env.state.projected_gravity[rows]
    w, x, y, z = values["base_quat"].T
    down = -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(gravity, down, atol=1e-5)
    # it is observed, and it is where the physics goes on
    start = env.sim.observation_groups["policy"][0]
    layout = dict(env.observation_layout)
    assert list(layout)[:3] == ["base_lin_vel", "base_ang_vel", "projected_gravity"]
    seen = env.sim.observation[rows][:, start : start + 9]
    state = np.concatenate([values["base_lin_vel"], values["base_ang_vel"], gravity], axis=1)
    assert np.abs(seen - state).max() < 0.3, "beyond the task's noise"
    position = env.state.base_pos[rows]
    walk(env, 1, 9)
    assert np.abs(env.state.base_pos[rows] - position).max() < 0.1


@pytest.mark.parametrize("name", ["base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "joint_pos", "joint_vel"])
def test_what_is_absent_stays(name):
    env = batch()
    walk(env, 4)
    fields = ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "joint_pos", "joint_vel")
    before = {field: env.sim.state(field) for field in fields}
    values = some_state(8, env.sim.num_actions) | {"joint_pos": env.state.default_joint_pos}
    env.sim.set_state(**{name: values[name]})
    for field in fields:
        wanted = values[name] if field == name else before[field]
        np.testing.assert_allclose(env.sim.state(field), wanted, atol=3e-6, err_msg=field)


def change(env, step, rows):
    """Sets something in some envs after a step."""
    if step == 1:
        env.sim.set_state(rows, **some_state(3, env.sim.num_actions))
    if step == 2:
        env.sim.set_friction(0.3, env_ids=rows)
        env.sim.set_mass(20.0, env_ids=rows)
        env.sim.set_gains(30.0, [1.0] * env.sim.num_actions, env_ids=rows)
    if step == 3:
        env.sim.apply_force([50.0, 10.0, 0.0], [0.0, 1.0, 0.0], env_ids=rows, steps=2)
        env.sim.apply_force([0.0, 5.0, 0.0], link="FL_calf", frame="link", env_ids=rows[:1])
        env.sim.apply_force([0.0, 5.0, 1.0], link="FL_hip", env_ids=rows[:2])
        env.sim.set_command(np.full((3, 3), 0.5, np.float32), env_ids=rows)


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_other_envs_keep_their_bits(engine):
    """Whatever is set in some envs leaves the bits of all others, over threads too."""
    count = 40 if engine == "articulated" else 8
    env, threaded, plain = (batch(count, engine, threads) for threads in (1, 3, 1))
    rows = np.array([0, 2, count // 2 + 1])
    others = np.setdiff1d(np.arange(count), rows)
    for step in range(6):
        for one in (env, threaded, plain):
            one.step(drawn(one, step))
        for one in (env, threaded):
            change(one, step, rows)
        assert everything(env) == everything(threaded), step
        assert everything(env, others) == everything(plain, others), step
    assert everything(env, rows) != everything(plain, rows)


def test_neighbours_in_a_pack_do_not_decide_an_envs_forces():
    """An env with forces goes on the same, whatever forces its neighbours have."""
    found = []
    for neighbours in ([], ["FR_calf", "FL_hip", "FL_calf"]):
        env = batch(16, robots=["unitree_go2"])
        for link in neighbours:
            env.sim.apply_force([1.0, 2.0, 3.0], link=link, env_ids=[0, 1, 9], steps=3)
        for link in ("FL_thigh", "FL_calf", "FL_hip"):
            env.sim.apply_force([4.0, 5.0, -6.0], [0.3, 0.1, 0.2], link=link, env_ids=[4, 12], steps=3)
        walk(env, 3)
        found.append(everything(env, [2, 4, 12]))
    assert found[0] == found[1]


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_the_past_of_the_solver_is_forgotten(engine):
    """Equal robots that are set to one state go on with the same bits, whatever they did before."""
    events = ("push_robot", "base_com", "add_base_mass", "physics_material")
    overrides = {f"events.{event}.enabled": False for event in events}
    env = batch(4, engine, robots=["unitree_go2"], overrides=overrides)
    moving = np.zeros((4, env.sim.num_actions), np.float32)
    moving[:, 0] = [0.0, 0.4, -0.4, 0.8]
    for _ in range(20):
        env.step(moving)
    assert np.abs(env.state.contact_forces[0]).max() > 10.0
    # for the first env this is the state that it is in
    fields = ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "joint_pos", "joint_vel")
    env.sim.set_state(**{field: env.sim.state(field)[0] for field in fields})
    env.step(np.zeros_like(moving))
    for field in (*fields, "contact_forces", "joint_effort", "feet_pos"):
        found = env.sim.state(field)
        np.testing.assert_array_equal(found, np.broadcast_to(found[0], found.shape), err_msg=field)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"base_pos": [[0.0, np.nan, 1.0]]}, ["base_pos", "NaN", "env 2", "finite"]),
        ({"base_pos": [[0.0, np.inf, 1.0]]}, ["base_pos", "inf", "env 2"]),
        ({"base_pos": [[1e7, 0.0, 1.0]]}, ["base_pos", "env 2", "beyond"]),
        ({"base_quat": [[2.0, 0.0, 0.0, 0.0]]}, ["base_quat", "env 2", "length 2", "w, x, y, z"]),
        ({"base_quat": [[0.0, 0.0, 0.0, 0.0]]}, ["base_quat", "length 0"]),
        ({"base_lin_vel": [[1e3, 0.0, 0.0]]}, ["base_lin_vel", "beyond 100"]),
        ({"base_ang_vel": [[1e3, 0.0, 0.0]]}, ["base_ang_vel", "beyond"]),
        ({"joint_vel": np.full((1, 12), 1e4)}, ["joint_vel", "beyond"]),
        ({"joint_pos": np.full((1, 12), 9.0)}, ["joint_pos", "FL_hip_joint", "limits", "np.clip"]),
        ({"base_pos": np.zeros((2, 3))}, ["base_pos", "(2, 3)", "(1, 3)"]),
        ({"joint_pos": np.zeros((1, 11))}, ["joint_pos", "(1, 11)", "(1, 12)"]),
        ({"joint_pos": np.array([["a"] * 12])}, ["joint_pos", "numbers"]),
    ],
)
def test_wrong_states_are_refused(values, words):
    env = batch(4, robots=["unitree_go2"])
    before = everything(env)
    with pytest.raises((ConfigError, ValueError, TypeError)) as error:
        env.sim.set_state([2], **({"joint_vel": np.ones((1, 12))} | values))
    assert all(word in str(error.value) for word in ["set_state", *words]), error.value
    assert everything(env) == before


@pytest.mark.parametrize(
    ("env_ids", "words"),
    [
        ([4], ["no env 4", "0 to 3"]),
        ([-1], ["no env -1"]),
        ([1, 1], ["env 1", "twice"]),
        ([True, False, False, False], ["mask", "np.flatnonzero"]),
        ([0.5], ["integers"]),
        ([[0, 1]], ["dimension"]),
    ],
)
def test_wrong_envs_are_refused(env_ids, words):
    env = batch(4, robots=["unitree_go2"])
    calls = {
        "set_state": lambda: env.sim.set_state(env_ids, base_pos=[0.0, 0.0, 1.0]),
        "set_friction": lambda: env.sim.set_friction(0.5, env_ids=env_ids),
        "set_mass": lambda: env.sim.set_mass(5.0, env_ids=env_ids),
        "set_gains": lambda: env.sim.set_gains(5.0, env_ids=env_ids),
        "apply_force": lambda: env.sim.apply_force([1.0, 0.0, 0.0], env_ids=env_ids),
        "set_command": lambda: env.sim.set_command(None, env_ids=env_ids),
        "snapshot": lambda: env.sim.snapshot(env_ids),
    }
    for method, call in calls.items():
        with pytest.raises((ConfigError, ValueError, TypeError)) as error:
            call()
        assert all(word in str(error.value) for word in [method, *words]), error.value


def test_wrong_parameters_and_forces_are_refused():
    env = batch(4, robots=["unitree_go2"])
    sim, before = env.sim, everything(env)
    wrong = [
        (lambda: sim.set_friction(-0.1), ["set_friction", "static_friction", "-0.1", "negative"]),
        (lambda: sim.set_friction(np.nan), ["set_friction", "NaN"]),
        (lambda: sim.set_friction([0.5, 0.5]), ["set_friction", "(2,)", "(4,)"]),
        (lambda: sim.set_mass(0.0), ["set_mass", "0 kg", "positive"]),
        (lambda: sim.set_mass(1.0, "trunk"), ["set_mass", "trunk", "link"]),
        (lambda: sim.set_gains(-1.0), ["set_gains", "stiffness", "negative"]),
        (lambda: sim.set_gains(damping=[1.0, 2.0]), ["set_gains", "damping", "(2,)", "(4, 12)"]),
        (lambda: sim.apply_force([np.inf, 0, 0]), ["apply_force", "force", "inf"]),
        (lambda: sim.apply_force([0, 0, 0], link="FL_claf"), ["apply_force", "FL_claf", "FL_calf"]),
        (lambda: sim.apply_force([0, 0, 0], frame="body"), ["apply_force", "frame", "body", "world"]),
        (lambda: sim.apply_force([0, 0, 0], steps=0), ["apply_force", "steps", "one control step"]),
        (lambda: sim.apply_force([0, 0, 0], steps=1, duration_s=1.0), ["apply_force", "duration_s", "steps"]),
        (lambda: sim.apply_force([0, 0, 0], duration_s=-1.0), ["apply_force", "duration_s", "positive"]),
    ]
    for call, words in wrong:
        with pytest.raises((ConfigError, ValueError, TypeError)) as error:
            call()
        assert all(word in str(error.value) for word in words), error.value
    with pytest.raises(UnknownNameError):
        sim.set_mass(1.0, "trunk")
    assert everything(env) == before


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_friction_and_mass_act(engine):
    """A robot that is heavier presses harder, one without friction slides."""
    overrides = {"events.push_robot.enabled": False, "terminations.base_contact": None}
    env = batch(4, engine, robots=["unitree_go2"], overrides=overrides)
    mass = env.sim.parameters("unitree_go2")["mass"][:, 0]
    env.sim.set_mass(mass + np.array([0.0, 5.0, 0.0, 0.0]))
    env.sim.set_friction([1.0, 1.0, 0.0, 1.0])
    env.sim.set_gains(np.array([[40.0], [40.0], [40.0], [5.0]]).repeat(12, axis=1))
    np.testing.assert_allclose(env.sim.parameters("unitree_go2")["mass"][1, 0], mass[1] + 5.0)
    np.testing.assert_array_equal(env.sim.parameters("unitree_go2")["stiffness"][3], np.full(12, 5.0, np.float32))
    rest = np.zeros((4, 12), np.float32)
    for _ in range(60):
        env.step(rest)
    pressed = env.state.contact_forces.reshape(4, -1, 3)[:, :, 2].sum(axis=1)
    drawn_masses = env.sim.parameters("unitree_go2")["mass"].sum(axis=1)
    np.testing.assert_allclose(pressed[:2], 9.81 * drawn_masses[:2], rtol=0.05)
    heights = env.state.base_height
    assert heights[3] < heights[0] - 0.03, "weak legs give way"
    sideways = np.abs(env.state.contact_forces.reshape(4, -1, 3)[:, :, :2]).max(axis=(1, 2))
    assert sideways[2] < 1e-3
    assert sideways[0] > 0.0


def test_set_parameters_hold_through_resets():
    env = batch(4, robots=["unitree_go2"])
    env.sim.set_mass([11.0], env_ids=[2])
    env.sim.set_friction(0.37, 0.21, env_ids=[2])
    mine = env.sim.parameters("unitree_go2")
    mask = np.ones(4, np.bool_)
    env.reset(options={"reset_mask": mask})
    for name, values in env.sim.parameters("unitree_go2").items():
        np.testing.assert_array_equal(values, mine[name])
    env.reset(seed=3)
    assert env.sim.parameters("unitree_go2")["mass"][2, 0] != 11.0
    # an event at a reset starts from the set number
    drawing = batch(
        4,
        robots=["unitree_go2"],
        overrides={"events.add_base_mass.mode": "reset", "events.physics_material.mode": "reset"},
    )
    drawing.sim.set_mass(50.0, env_ids=[1])
    drawing.sim.set_friction(9.0, env_ids=[1])
    drawing.reset(options={"reset_mask": mask})
    now = drawing.sim.parameters("unitree_go2")
    assert 40.0 < now["mass"][1, 0] < 60.0
    assert now["mass"][1, 0] != 50.0
    assert now["static_friction"][1] < 5.0


def momentum(env, robot):
    """About the linear momentum: the links' origins stand for their centres of mass."""
    links, mass = env.sim.links(robot), env.sim.parameters(robot)["mass"]
    return (mass[:, :, None] * links["lin_vel"]).sum(axis=1)


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_forces_on_links_push_and_end(engine):
    env = batch(6, engine, robots=["unitree_go2"], overrides=FREE)
    rest = np.zeros((6, 12), np.float32)
    env.sim.set_state(base_pos=[0.0, 0.0, 2.0], base_lin_vel=np.zeros(3), base_ang_vel=np.zeros(3))
    level = [1.0, 0.0, 0.0, 0.0]
    env.sim.set_state(base_quat=level, joint_pos=env.state.default_joint_pos, joint_vel=np.zeros(12))
    names = env.sim.link_names("unitree_go2")
    force = np.array([3.0, -2.0, 4.0])
    env.sim.apply_force(force, link=names[0], env_ids=[1], steps=2)
    env.sim.apply_force(force, link="FL_calf", env_ids=[2], duration_s=2 * env.step_dt)
    env.sim.apply_force(force, link="RR_thigh", env_ids=[3], steps=2, point=[0.0, 0.0, -0.1])
    env.sim.apply_force([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], env_ids=[4], steps=2)
    # the same link again: the second call counts
    env.sim.apply_force([99.0, 0.0, 0.0], link="FL_calf", env_ids=[5], steps=9)
    env.sim.apply_force(force, link="FL_calf", env_ids=[5], steps=2)
    mass = env.sim.parameters("unitree_go2")["mass"].sum(axis=1)
    for step in range(1, 4):
        env.step(rest)
        speed = env.state.base_lin_vel
        if step == 1:
            continue
        # the legs' motion against the base is small: the base moves as the whole does
        wanted = force * 2 * env.step_dt / mass[1]
        np.testing.assert_allclose(speed[1], wanted, atol=0.15 * np.abs(wanted).max())
        assert np.abs(speed[0]).max() < 2e-3
    assert np.abs(momentum(env, "unitree_go2")[2] - momentum(env, "unitree_go2")[5]).max() < 0.05
    assert env.state.base_ang_vel[4, 2] > 0.01
    moved = [np.abs(env.state.joint_vel[row]).max() for row in (2, 3)]
    assert min(moved) > 5 * np.abs(env.state.joint_vel[0]).max()


def test_both_engines_agree_on_forces_on_links():
    found = []
    for engine in ("articulated", "avian"):
        env = batch(3, engine, robots=["unitree_go2"], overrides=FREE)
        env.sim.set_state(base_pos=[0.0, 0.0, 2.0], base_lin_vel=np.zeros(3), base_ang_vel=np.zeros(3))
        env.sim.set_state(base_quat=[0.8, 0.0, 0.6, 0.0], joint_pos=env.state.default_joint_pos, joint_vel=np.zeros(12))
        torque, point = [0.1, 0.3, -0.2], [0.0, 0.05, -0.1]
        env.sim.apply_force([2.0, 5.0, -3.0], torque, link="FL_calf", env_ids=[0], point=point, steps=3)
        env.sim.apply_force([2.0, 5.0, -3.0], torque, link="FL_calf", env_ids=[1], point=point, frame="link", steps=3)
        for _ in range(3):
            env.step(np.zeros((3, 12), np.float32))
        found.append(np.concatenate([env.state.base_lin_vel, env.state.base_ang_vel, env.state.joint_vel], axis=1))
    ours, theirs = found
    size = np.abs(ours - ours[2]).max(axis=1)
    assert (size[:2] > 0.5).all()
    assert (np.abs(ours - theirs)[:2].max(axis=1) < 0.08 * size[:2]).all(), np.abs(ours - theirs).max(axis=1)
    assert np.abs(ours[0] - ours[1]).max() > 0.2 * size[0], "the frame makes no difference"


def test_snapshots_hold_what_was_set():
    env, twin = batch(), batch()
    walk(env, 2)
    env.sim.set_state([1, 5], **some_state(2, env.sim.num_actions))
    env.sim.set_friction(0.2, env_ids=[0])
    env.sim.set_mass(9.0, env_ids=[1])
    env.sim.set_gains(11.0, env_ids=[2])
    env.sim.apply_force([40.0, 0.0, 0.0], env_ids=[3, 4], steps=4)
    env.step(drawn(env, 2))
    saved = env.sim.snapshot()
    walk(env, 5, 3)
    twin.sim.restore(saved)
    walk(twin, 5, 3)
    assert everything(env) == everything(twin)


@pytest.mark.parametrize("engine", ["articulated", "avian"])
def test_snapshots_of_some_envs_go_on_equal(engine):
    env, twin = batch(8, engine), batch(8, engine)
    walk(env, 4)
    walk(twin, 4)
    rows = [6, 1]
    others = [row for row in range(8) if row not in rows]
    saved = env.sim.snapshot(rows)
    assert len(saved) < len(env.sim.snapshot()) / 2
    kept = everything(env, rows)
    walk(env, 3, 4)
    walk(twin, 3, 4)
    before, later = everything(env, others), everything(twin, rows)
    env.sim.restore(saved)
    assert everything(env, rows) == kept
    assert everything(env, others) == before
    # the others go on as ever, these as they did from the snapshot
    walk(env, 3, 4)
    assert everything(env, rows) == later
    walk(twin, 3, 4)
    assert everything(env, others) == everything(twin, others)
    env.sim.restore(saved, [1])
    assert everything(env, [1]) == everything(walked(engine), [1])
    env.sim.restore(saved)
    walk(env, 3, 4)
    assert everything(env, rows) == later
    with pytest.raises(ConfigError, match="without env 2"):
        env.sim.restore(saved, [2])


def walked(engine):
    env = batch(8, engine)
    walk(env, 4)
    return env


def test_some_envs_of_a_whole_snapshot_are_restored():
    env, twin = batch(), batch()
    walk(env, 4)
    walk(twin, 4)
    saved = env.sim.snapshot()
    kept = everything(env)
    walk(env, 2, 4)
    walk(twin, 2, 4)
    env.sim.restore(saved, [3])
    assert everything(env, [3]) == everything(walked("articulated"), [3])
    others = [0, 1, 2, 4, 5, 6, 7]
    assert everything(env, others) == everything(twin, others)
    env.sim.restore(saved)
    assert everything(env) == kept


def test_resets_begin_in_given_states():
    env = batch(6, robots=["unitree_go2"])
    walk(env, 3)
    mask = np.array([False, True, False, True, False, False])
    others = ~mask
    before = everything(env, others)
    pose = env.state.default_joint_pos[mask] + 0.1
    start = {"joint_pos": pose, "base_pos": [[0.1, 0.2, 0.5], [0.0, 0.0, 0.6]]}
    observation, _ = env.reset(options={"reset_mask": mask, "state": start})
    np.testing.assert_allclose(env.state.joint_pos[mask], pose, atol=1e-6)
    np.testing.assert_allclose(env.state.base_pos[mask], start["base_pos"], atol=1e-6)
    np.testing.assert_array_equal(env.state.episode_length[mask], 0)
    np.testing.assert_array_equal(observation, env.sim.observation)
    assert everything(env, others) == before
    with pytest.raises(ValueError, match="joint_position"):
        env.reset(options={"reset_mask": mask, "state": {"joint_position": pose}})
    with pytest.raises(TypeError, match="dict"):
        env.reset(options={"state": pose})
    before = everything(env)
    with pytest.raises(ConfigError, match="base_quat"):
        env.reset(options={"reset_mask": mask, "state": {"base_quat": [0.0, 0.0, 0.0, 2.0]}})
    assert everything(env) == before, "a state that is refused resets nothing"


def test_links_are_where_the_feet_and_the_base_say():
    env = batch()
    walk(env, 30)
    for robot in ROBOTS:
        rows = env.env_ids(robot)
        links, names = env.sim.links(robot), env.sim.link_names(robot)
        assert links["pos"].shape == (len(rows), len(names), 3)
        assert links["quat"].shape[2] == 4
        np.testing.assert_allclose(links["pos"][:, 0], env.state.base_pos[rows], atol=1e-6)
        quat = env.state.base_quat[rows]
        np.testing.assert_allclose(links["quat"][:, 0], quat * np.sign(quat[:, :1]), atol=1e-5)
        np.testing.assert_allclose(links["pos"], env.sim.link_pose(robot)[0], atol=1e-5)
        np.testing.assert_allclose(links["lin_vel"][:, 0], env.sim.qvel(robot)[:, :3], atol=1e-5)
        forces = env.state.contact_forces[rows].reshape(len(rows), -1, 3).sum(axis=1)
        assert np.abs(forces).max() > 10.0
        total = env.sim.contact_forces(robot).sum(axis=1)
        np.testing.assert_allclose(links["contact_force"].sum(axis=1), total, atol=1e-3)
    # velocities are the rates of positions
    env.sim.set_state(base_pos=[0.0, 0.0, 3.0])
    before = env.sim.links(ROBOTS[0])
    env.step(drawn(env, 99))
    after = env.sim.links(ROBOTS[0])
    rate = (after["pos"] - before["pos"]) / env.step_dt
    mean = 0.5 * (before["lin_vel"] + after["lin_vel"])
    assert np.abs(rate - mean).max() < 0.5 * max(np.abs(mean).max(), 1.0)


def test_some_links_are_those_among_all():
    env = batch()
    walk(env, 30)
    for robot in ROBOTS:
        names = env.sim.link_names(robot)
        chosen = [names[4], names[0], names[-1], names[4]]
        every, some = env.sim.links(robot), env.sim.links(robot, chosen)
        assert np.abs(every["contact_force"]).max() > 10.0
        for part, rows in every.items():
            np.testing.assert_array_equal(some[part], rows[:, [4, 0, len(names) - 1, 4]], err_msg=part)
    assert env.sim.links(ROBOTS[0], [])["quat"].shape == (len(env.env_ids(ROBOTS[0])), 0, 4)
    with pytest.raises(UnknownNameError, match=r"links: names: there is no link `FL_calff`; did you mean `FL_calf`"):
        env.sim.links("unitree_go2", ["FL_calff"])
    with pytest.raises(TypeError):
        env.sim.links("unitree_go2", "FL_calf")


def test_links_have_the_same_bits_for_any_threads_and_instruction_set(monkeypatch):
    found = []
    for simd, threads in (("portable", 1), ("", 1), ("", 3)):
        monkeypatch.setenv("POLYPOD_SIMD", simd)
        env = batch(2 * 150, threads=threads)
        walk(env, 10)
        found.append([[rows.tobytes() for rows in env.sim.links(robot).values()] for robot in ROBOTS])
    assert found[0] == found[1] == found[2]


def test_commands_of_some_envs_are_pinned():
    env = batch(6, robots=["unitree_go2"])
    others = [0, 1, 3, 5]
    before = env.sim.command.copy()
    env.sim.set_command(np.array([[0.3, 0.0, 0.1], [0.6, 0.1, 0.0]], np.float32), env_ids=[4, 2])
    np.testing.assert_allclose(env.sim.command[[4, 2]], [[0.3, 0.0, 0.1], [0.6, 0.1, 0.0]])
    np.testing.assert_array_equal(env.sim.command[others], before[others])
    env.reset(options={"reset_mask": np.ones(6, np.bool_)})
    np.testing.assert_allclose(env.sim.command[[4, 2]], [[0.3, 0.0, 0.1], [0.6, 0.1, 0.0]])
    env.sim.set_command(None, env_ids=[2])
    env.reset(options={"reset_mask": np.ones(6, np.bool_)})
    assert np.abs(env.sim.command[2] - [0.6, 0.1, 0.0]).max() > 1e-4
    np.testing.assert_allclose(env.sim.command[4], [0.3, 0.0, 0.1])


def test_every_command_of_a_task_can_be_read_and_pinned():
    commands = {"heading": {"heading": [1.0, 2.0], "resampling_time_s": 0.02}, "jump": {"time": [0.5, 1.0]}}
    env = batch(4, robots=["unitree_go2"], overrides={"commands": commands})
    sim = env.sim
    assert sim.command_columns() == {
        "base_velocity": ["lin_vel_x", "lin_vel_y", "ang_vel_z"],
        "heading": ["heading"],
        "jump": ["time", "height", "length"],
    }
    np.testing.assert_array_equal(sim.command_of("base_velocity"), sim.command)
    drawn_headings = sim.command_of("heading")
    assert drawn_headings.shape == (4, 1)
    assert ((drawn_headings >= 1.0) & (drawn_headings <= 2.0)).all()
    sim.set_command(np.array([[0.5], [0.25]], np.float32), env_ids=[3, 1], name="heading")
    env.step(drawn(env, 0))
    np.testing.assert_array_equal(sim.command_of("heading")[[3, 1], 0], [0.5, 0.25])
    assert (sim.command_of("heading")[[0, 2]] >= 1.0).all()
    # the time of a pinned jump runs on
    sim.set_command(np.full((4, 3), [-0.1, 0.2, 0.0], np.float32), name="jump")
    for step in range(3):
        env.step(drawn(env, step))
    np.testing.assert_allclose(sim.command_of("jump"), np.full((4, 3), [-0.04, 0.2, 0.0]), atol=1e-6)
    sim.set_command(None, name="heading")
    for step in range(4):
        env.step(drawn(env, step))
    assert (sim.command_of("heading") >= 1.0).all()
    # a copy is handed out
    sim.command_of("heading")[:] = 0.0
    assert (sim.command_of("heading") >= 1.0).all()
    with pytest.raises(ConfigError, match=r"no command `headin`.*did you mean `heading`"):
        sim.command_of("headin")
    with pytest.raises(ConfigError, match="no command `gait`"):
        sim.set_command(None, name="gait")
    with pytest.raises((ConfigError, ValueError), match=r"not \(4, 1\)"):
        sim.set_command(np.zeros((4, 3), np.float32), name="heading")


def test_writing_into_what_was_handed_out_is_an_error():
    env = batch(copy=False)
    observation, reward, terminated, truncated, _ = env.step(drawn(env, 0))
    robot, sim = ROBOTS[0], env.sim
    arrays = {
        "observation": observation,
        "reward": reward,
        "terminated": terminated,
        "truncated": truncated,
        "sim.observation_of": sim.observation_of("policy"),
        "command": sim.command,
        "final_obs": sim.final_obs,
        "final_mask": sim.final_mask,
        "qpos": sim.qpos(robot),
        "qvel": sim.qvel(robot),
        "link_pose": sim.link_pose(robot)[0],
        "contact_forces": sim.contact_forces(robot),
        "episode_length": sim.episode_length,
        "env_origins": sim.env_origins(),
        **{f"state.{name}": getattr(env.state, name) for name in ("base_pos", "base_height", "joint_pos", "command")},
        **{f"links.{name}": array for name, array in sim.links(robot).items()},
        **{f"parameters.{name}": array for name, array in sim.parameters(robot).items()},
    }
    for name, array in arrays.items():
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
        assert not array.flags.writeable, name
    # a kept array may be changed
    mine = batch().step(drawn(env, 0))[0]
    mine[...] = 0.0
