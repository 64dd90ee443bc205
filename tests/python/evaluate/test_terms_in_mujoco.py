"""Terms in Python see MuJoCo's state as they see polypod's: the same names, the same values."""

import numpy as np
import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY
from polypod import terms
from polypod.export import interfaces
from polypod.python_terms import Terms
from polypod.python_terms.declarations import declared_by
from polypod.runs import run_dir
from polypod.sim2sim import beginning, own_terms, run

ROBOTS = ["unitree_a1", "spot"]
FIELDS = ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel")
FIELDS += ("feet_pos", "feet_height", "feet_vel", "default_joint_pos")
WIDTH = 85


@terms.observation(size=1)
def everything(env):
    """All that a state holds."""
    parts = [np.asarray(getattr(env, field)) for field in FIELDS]
    links = [env.sim.links(robot, env.sim.link_names(robot)[-1:]) for robot in env.robots]
    poses = np.concatenate([np.concatenate([of[key][:, 0] for of in links]) for key in ("pos", "quat")], axis=1)
    whole = np.concatenate([*parts, env.base_height[:, None], env.valid[:, None], poses[:, :3]], axis=1)
    env.memory["seen"][:] = whole
    return whole[:, 0]


seen = terms.memory("seen", size=WIDTH, dtype="float64")
count = terms.memory("count")


@everything.update
def counts(env):
    env.memory["count"][:] += 1.0


@terms.command(size=2, units="m", resampling_time_s=(0.1, 0.3))
def goal(env, ids):
    return env.random.uniform(-1.0, 1.0, ids, size=2)


@terms.termination()
def too_low(env):
    return env.base_height < 0.2


@terms.event(mode="reset")
def lifted(env, ids):
    env.sim.set_state(ids, base_pos=env.base_pos[ids] + np.float32([0.1, 0.0, 0.05]))


class Still:
    """A policy that holds the default pose."""

    def __init__(self, interface):
        """For a robot."""
        self.interface = interface
        self.inputs = {"joint_pos": len(interface.joint_names), "goal": 2}
        self.given = []

    def __call__(self, joint_pos, goal):
        """Notes the goal."""
        self.given.append(np.array(goal))
        n = len(joint_pos)
        actions = np.zeros((n, self.interface.num_actions), dtype=np.float32)
        return {"joint_pos_target": np.tile(self.interface.default_pose, (n, 1)), "actions": actions}

    def reset(self):
        """Remembers nothing."""


def stage(*entries, robot="spot", num_envs=3):
    """Terms over MuJoCo's state, MuJoCo's robots, their policy, and the episode."""
    manifest = run_dir.read_manifest(FLAT_POLICY)
    found = Terms.of(list(declared_by(entries)), "task.py")
    episode = run.Episode(manifest, ROBOTS, beginning.Options(num_envs, steps=50, seed=5), found)
    interface = interfaces(manifest, [robot])[robot]
    policy = Still(interface)
    own = episode.own_terms(robot)
    twin = beginning.twin_of(episode, robot, robot, interface, own.policy(policy))
    return own, twin, policy, episode


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_observation_and_a_command_have_the_same_values_at_the_same_state(robot):
    own, twin, _, episode = stage(seen, count, goal, everything, robot=robot)
    sim = episode.sim
    rows = slice(*sim.env_ids(robot))
    random = np.random.default_rng(0)
    for _ in range(20):
        sim.step(random.normal(size=(sim.num_envs, 12)).astype(np.float32))
    twin.reset(sim.qpos(robot), sim.qvel(robot))
    own.begin(twin)
    ours, theirs = (of.view.memory["seen"][rows] for of in (sim, own.sim))
    assert ours.shape == (3, WIDTH)
    np.testing.assert_allclose(theirs, ours, atol=2e-5)
    assert (np.abs(ours) > 1e-3).mean() > 0.5


def test_commands_are_drawn_and_memory_is_kept_as_in_polypod():
    own, twin, policy, episode = stage(seen, count, goal, everything)
    twin.reset(*episode.start["spot"])
    own.begin(twin)
    sim, rows = episode.sim, slice(*episode.sim.env_ids("spot"))
    drawn = []
    for _ in range(60):
        drawn.append(sim.view.commands["goal"][rows].copy())
        own.step(twin, np.zeros((3, 3), dtype=np.float32), np.ones(3, dtype=np.bool_))
        sim.step(np.zeros((sim.num_envs, 12), dtype=np.float32))
        np.testing.assert_array_equal(own.sim.view.memory["count"], sim.view.memory["count"])
    np.testing.assert_array_equal(np.stack(policy.given), np.stack(drawn))
    assert len(np.unique(np.stack(drawn)[:, 0, 0])) > 3


def test_reset_events_place_both():
    own, twin, _, episode = stage(seen, count, goal, lifted, everything)
    _, _, _, plain = stage(seen, count, goal, everything)
    np.testing.assert_allclose(
        episode.start["spot"][0] - plain.start["spot"][0], [[0.1, 0, 0.05] + [0] * 16] * 3, atol=1e-6
    )
    twin.reset(*episode.start["spot"])
    own.begin(twin)
    np.testing.assert_allclose(own.sim.view.base_pos, episode.sim.view.base_pos, atol=1e-6)


def test_a_termination_ends_an_episode_in_mujoco():
    own, twin, _, episode = stage(seen, count, goal, everything, too_low)
    qpos, qvel = episode.start["spot"]
    qpos = qpos.copy()
    qpos[1, 2] = 0.17
    qpos[1, 3:7] = [0.0, 1.0, 0.0, 0.0]
    twin.reset(qpos, qvel)
    own.begin(twin)
    found = own.step(twin, np.zeros((3, 3), dtype=np.float32), np.ones(3, dtype=np.bool_))
    assert found.fell.tolist() == [False, True, False]


@pytest.mark.parametrize("field", sorted(own_terms.REFUSED))
def test_what_mujoco_does_not_answer_is_refused_by_name(field):
    @terms.observation(size=1)
    def reads(env):
        return getattr(env, field)[:, 0]

    own, twin, _, episode = stage(reads)
    twin.reset(*episode.start["spot"])
    with pytest.raises(polypod.ConfigError, match=rf"task\.py: the term 'reads' failed: .*{field}: MuJoCo does not"):
        own.begin(twin)


@pytest.mark.parametrize(
    ("name", "call"), [("push", lambda env: env.sim.push(env.base_lin_vel)), ("log", lambda env: env.sim.log())]
)
def test_polypod_s_simulator_is_refused_by_name(name, call):
    @terms.termination()
    def asks(env):
        call(env)
        return env.base_height < 0.0

    own, twin, _, episode = stage(asks)
    twin.reset(*episode.start["spot"])
    with pytest.raises(polypod.ConfigError, match=rf"the term 'asks' failed: .*env\.sim\.{name}: it is of polypod"):
        own.begin(twin)


def test_contact_forces_of_links_are_refused():
    @terms.observation(size=1)
    def pressed(env):
        return np.concatenate([env.sim.links(robot)["contact_force"][:, 0, 2] for robot in env.robots])

    own, twin, _, episode = stage(pressed)
    twin.reset(*episode.start["spot"])
    with pytest.raises(polypod.ConfigError, match="links: contact_force: MuJoCo does not answer it"):
        own.begin(twin)
