"""Mirror images: an involution that exchanges left and right, and that the physics agrees with."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import polypod
import polypod.rsl_rl
from common import SMALL_TERRAIN
from polypod.training.symmetry import Mirror

TASKS = ["velocity_flat_play", "velocity_flat_universal_play", "velocity_rough_play"]


def mirror_of(task: str) -> tuple[polypod.rsl_rl.VecEnv, Mirror]:
    overrides = SMALL_TERRAIN if "rough" in task else ()
    env = polypod.rsl_rl.VecEnv(polypod.make(task, num_envs=16, seed=3, overrides=overrides))
    return env, Mirror(env, "cpu")


@pytest.mark.parametrize("task", TASKS)
def test_a_mirror_image_of_a_mirror_image_is_the_original(task: str) -> None:
    env, mirror = mirror_of(task)
    observations = env.get_observations()
    actions = torch.randn(16, 12)
    both, both_actions = mirror.augment(env, observations, actions)
    assert both is not None
    assert both_actions is not None
    assert torch.equal(both["policy"][:16], observations["policy"])
    image = TensorDict({"policy": both["policy"][16:]}, batch_size=[16])
    again, again_actions = mirror.augment(env, image, both_actions[16:])
    assert again is not None
    assert again_actions is not None
    assert torch.equal(again["policy"][16:], observations["policy"])
    assert torch.equal(again_actions[16:], actions)
    assert not torch.equal(both_actions[16:], actions)


def test_left_becomes_right() -> None:
    env, mirror = mirror_of(TASKS[0])
    names = env.unwrapped.canonical_joint_names
    actions = torch.zeros(1, 12)
    actions[0, names.index("LF_HAA")] = 1.0
    actions[0, names.index("RH_KFE")] = 0.5
    _, both = mirror.augment(env, None, actions)
    assert both is not None
    image = both[1]
    assert image[names.index("RF_HAA")] == -1.0
    assert image[names.index("LH_KFE")] == 0.5
    assert image.abs().sum() == 1.5


def test_the_physics_has_the_same_mirror() -> None:
    """Mirrored actions from the (symmetric) default pose lead to mirrored observations."""
    env = polypod.rsl_rl.VecEnv(
        polypod.make(
            "velocity_flat_play",
            num_envs=2,
            robots=["unitree_go2"],
            seed=0,
            overrides=[
                "events.reset_base.yaw=[0.0, 0.0]",
                "commands.base_velocity.rel_standing_envs=1.0",
                "commands.base_velocity.rel_heading_envs=0.0",
            ],
        )
    )
    mirror = Mirror(env, "cpu")
    rng = np.random.default_rng(0)
    for _ in range(15):
        action = torch.from_numpy(rng.normal(size=(1, 12)).astype(np.float32))
        _, both = mirror.augment(env, None, action)
        assert both is not None
        observations, *_ = env.step(both)
    expected, _ = mirror.augment(env, observations[:1], None)
    assert expected is not None
    found, image = observations["policy"][1], expected["policy"][1]
    # the vendor's masses differ a little between left and right
    np.testing.assert_allclose(found[:3], image[:3], atol=0.05)
    np.testing.assert_allclose(found[12:24], image[12:24], atol=0.05)
    assert not np.allclose(found[12:24], observations["policy"][0][12:24], atol=0.2)


def test_robots_with_other_mirrors_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    env, _ = mirror_of(TASKS[0])
    sim = env.unwrapped.sim

    class Sim:
        robots, observation_groups = sim.robots, sim.observation_groups
        action_mask = sim.action_mask
        env_ids, observation_mask = sim.env_ids, sim.observation_mask

        def action_mirror(self, robot: str) -> list[tuple[int, float]]:
            mirror = sim.action_mirror(robot)
            return mirror if robot != "spot" else [(slot, -sign) for slot, sign in mirror]

        def observation_mirror(self, robot: str, group: str) -> list[tuple[int, float]]:
            return sim.observation_mirror(robot, group)

    monkeypatch.setattr(env, "unwrapped", type("Env", (), {"sim": Sim()})())
    with pytest.raises(polypod.ConfigError, match="spot change sign differently"):
        Mirror(env, "cpu")


def test_the_morphology_term_describes_the_body() -> None:
    env = polypod.make("velocity_flat_universal_play", num_envs=8, seed=0)
    observations, _ = env.reset(seed=0)
    term = observations[:, 48:]
    assert term.shape == (8, 35)
    masses = {robot: term[env.env_ids(robot)[0], 0] * 50 for robot in env.robots}
    assert masses["spot"] == pytest.approx(31.6, abs=1.5)
    assert masses["unitree_b2"] > masses["anymal_d"] > masses["unitree_go2"]
    assert len({row.tobytes() for row in term}) == 8
