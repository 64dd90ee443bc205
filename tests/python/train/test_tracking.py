"""Tasks that track motions: what a perfect follower gets, what snapshots hold, who learns it."""

import json

import numpy as np
import pytest

import polypod
from polypod import _core, rotations
from polypod.cli import main
from polypod.motions import sampling
from polypod.motions.options import SamplingOptions, options
from polypod.motions.tracking import ERRORS
from polypod.python_terms import TermSim
from polypod.runs import run_dir

TASK = "tracking_flat_humanoid"
SQUAT = 'motions.clips=["squat"]'
ROBOTS = ["unitree_g1", "unitree_h1", "booster_t1"]
LINE = ("train", "--task", TASK, "--num-envs", "8", "--robots", "unitree_g1,booster_t1", "--logger", "none")
LINE += ("--set", SQUAT, "--set", "train.run.num_steps_per_env=6", "--seed", "5")
LINE += ("--set", "sim.episode_length_s=0.4", "--threads", "1")
LINE += ("--set", "train.actor.hidden_dims=[16]", "--set", "train.critic.hidden_dims=[16]")


def make(*changes, num_envs=6, robots=ROBOTS, play=False, **more):
    """A simulator of the task; without noise where it plays."""
    quiet = ["observations.enable_noise=false", "events.push_robot.enabled=false"]
    sim = polypod.vector_env.simulator(
        None, TASK, num_envs, play=play, robots=robots, seed=3, threads=1, overrides=[SQUAT, *quiet, *changes], **more
    )
    assert isinstance(sim, TermSim)
    return sim


def driven(sim, steps, seed=0):
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        sim.step(rng.uniform(-1.0, 1.0, (sim.num_envs, sim.num_actions)).astype(np.float32))
        rows.append([sim.observation.copy(), sim.reward.copy(), sim.terminated | sim.truncated])
    return rows


def columns(sim, term):
    start = 0
    for name, size in sim.observation_layout:
        if name == term:
            return slice(start, start + size)
        start += size
    raise KeyError(term)


EXACT = (
    *(f"motions.reset.pose_range.{axis}=[0.0, 0.0]" for axis in ("x", "y", "z", "roll", "pitch", "yaw")),
    *(f"motions.reset.velocity_range.{axis}=[0.0, 0.0]" for axis in ("x", "y", "z", "roll", "pitch", "yaw")),
    "motions.reset.joint_position_range=[0.0, 0.0]",
)
"""No noise where an episode begins."""


@pytest.mark.parametrize("frame", [0, 40, 90])
def test_a_perfect_follower_gets_one_from_each_term_and_sees_no_error(frame):
    sim = make(*EXACT)
    view = sim.view
    view.memory["motion_frame"][:] = frame
    sim.terms.events["reset_to_motion"].function(view, np.arange(sim.num_envs))
    for name in ERRORS:
        np.testing.assert_allclose(sim.terms.rewards[name].function(view), 1.0, atol=1e-4, err_msg=name)
    for term in sim.terms.terminations.values():
        assert not term.function(view).any()
    for name in ("error_anchor_pos", "error_anchor_rot", "error_body_pos"):
        np.testing.assert_allclose(sim.terms.metrics[name].function(view), 0.0, atol=1e-3)
    np.testing.assert_allclose(sim.terms.observations["motion_anchor_pos_b"].function(view), 0.0, atol=1e-5)
    ori = sim.terms.observations["motion_anchor_ori_b"].function(view)
    np.testing.assert_allclose(ori, np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 1.0], (6, 1)), atol=1e-4)


def test_terms_are_the_bells_of_their_errors_and_deviations_end_episodes():
    sim = make(*EXACT)
    view = sim.view
    height = view.base_pos[:, 2].copy()
    sim.set_state(base_pos=view.base_pos + np.float32([0.3, 0.0, 0.0]))
    view.refresh()
    sim.terms.observations["motion_command"].hooks["update"](view)
    view.memory["motion_frame"][:] -= 1
    term = sim.terms.rewards["motion_global_anchor_position_error_exp"].function(view)
    np.testing.assert_allclose(term, np.exp(-1.0), rtol=1e-3)
    # relative terms move the reference to the robot
    np.testing.assert_allclose(
        sim.terms.rewards["motion_relative_body_position_error_exp"].function(view), 1.0, atol=1e-3
    )
    assert not sim.terms.terminations["bad_anchor_pos_z_only"].function(view).any()
    sim.set_state([0], base_pos=[[0.3, 0.0, height[0] + 0.3]])
    view.refresh()
    sim.terms.observations["motion_command"].hooks["update"](view)
    view.memory["motion_frame"][:] -= 1
    assert list(np.flatnonzero(sim.terms.terminations["bad_anchor_pos_z_only"].function(view))) == [0]
    # hanging in the air moves all links up with the base
    assert list(np.flatnonzero(sim.terms.terminations["bad_motion_body_pos_z_only"].function(view))) == [0]


def test_robots_that_stay_behind_or_do_not_turn_fail():
    sim = make(*EXACT)
    view = sim.view
    turned = view.base_quat.astype(np.float64)
    turned[1] = rotations.product([np.cos(0.4), 0.0, 0.0, np.sin(0.4)], turned[1])
    moved = view.base_pos.copy()
    moved[0, :2] += [0.4, 0.4]
    sim.set_state(base_pos=moved, base_quat=turned)
    view.refresh()
    sim.terms.observations["motion_command"].hooks["update"](view)
    view.memory["motion_frame"][:] -= 1
    ends = {name: list(np.flatnonzero(term.function(view))) for name, term in sim.terms.terminations.items()}
    assert ends["bad_anchor_pos"] == [0]
    assert ends["bad_anchor_heading"] == [1]
    without = make(*EXACT, "motions.terminations.bad_anchor_pos.threshold=null").terms.terminations
    assert set(ends) - set(without) == {"bad_anchor_pos"}


def test_the_command_is_the_reference_ahead_by_joint_and_masks_hold():
    sim = make(*EXACT, "motions.look_ahead=[0, 2]", play=True)
    view, count = sim.view, sim.num_actions
    seen = sim.observation[:, columns(sim, "motion_command")].reshape(sim.num_envs, 4, count)
    mask = sim.action_mask
    assert not seen[~np.broadcast_to(mask[:, np.newaxis], seen.shape)].any()
    np.testing.assert_allclose(seen[:, 0], np.where(mask, view.joint_pos - view.default_joint_pos, 0.0), atol=1e-4)
    np.testing.assert_allclose(seen[:, 1], np.where(mask, view.joint_vel, 0.0), atol=1e-4)
    # two steps later the present frame is the one that was ahead
    sim.step(np.zeros((sim.num_envs, count), dtype=np.float32))
    sim.step(np.zeros((sim.num_envs, count), dtype=np.float32))
    after = sim.observation[:, columns(sim, "motion_command")].reshape(sim.num_envs, 4, count)
    np.testing.assert_allclose(after[:, :2], seen[:, 2:], atol=1e-5)


def test_a_clip_s_end_truncates_and_play_begins_clips_in_turn():
    sim = make(*EXACT, 'motions.clips=["wave", "squat"]', play=True, autoreset="disabled")
    assert list(sim.view.memory["motion_clip"][:, 0]) == [0, 1] * 3
    wave = make(*EXACT, "motions.terminations={}", 'motions.clips=["wave"]', robots=["unitree_h1"], num_envs=1)
    wave.view.memory["motion_frame"][:] = 290
    wave.terms.events["reset_to_motion"].function(wave.view, np.arange(1))
    zero = np.zeros((1, wave.num_actions), dtype=np.float32)
    ends = []
    for _ in range(10):
        wave.step(zero)
        ends.append((bool(wave.terminated[0]), bool(wave.truncated[0])))
    assert ends == [(False, False)] * 9 + [(False, True)]


def test_bins_that_fail_are_sampled_more_and_a_uniform_share_stays():
    chosen = SamplingOptions(adaptive=True, bin_s=1.0, kernel_size=2, kernel_lambda=0.5, uniform_ratio=0.1, alpha=0.1)
    bins = sampling.Bins([4.0, 2.0], chosen, robots=2)
    arrays = {memory.name: memory.array(1) for memory in bins.memories()}
    np.testing.assert_allclose(bins.probabilities(arrays, 0), 1.0 / 6.0)
    bins.count(arrays, 1, np.array([0, 0, 0]), np.array([0.55, 0.6, 0.7]))
    bins.decay(arrays)
    assert not arrays["motion_failing"].any()
    # the other robot does not notice
    np.testing.assert_allclose(bins.probabilities(arrays, 0), 1.0 / 6.0)
    likely = bins.probabilities(arrays, 1)
    share = np.array([0.0, 0.3 / 3.0, 2.0 * 0.3 / 3.0, 0.0, 0.0, 0.0]) + 0.1 / 6.0
    np.testing.assert_allclose(likely, share / share.sum())
    drawn = np.random.default_rng(0).uniform(size=(20_000, 2))
    clip, at = bins.sample(arrays, 1, drawn)
    found = np.bincount(bins.bin_of(clip, at), minlength=6) / len(drawn)
    np.testing.assert_allclose(found, likely, atol=0.01)
    assert bins.curves(arrays, 1)["top1_prob"] == pytest.approx(likely.max())
    assert bins.curves(arrays, 0)["entropy"] == pytest.approx(1.0)


def test_a_snapshot_goes_on_exactly_with_what_the_sampling_has_learnt():
    sim = make("motions.sampling.alpha=0.1")
    driven(sim, 30)
    assert sim.view.memory["motion_failed"].any()
    data = sim.snapshot()
    first = driven(sim, 40, seed=7)
    other = make("motions.sampling.alpha=0.1")
    driven(other, 3)
    other.restore(data)
    again = driven(other, 40, seed=7)
    assert all(np.array_equal(a, b) for x, y in zip(first, again, strict=True) for a, b in zip(x, y, strict=True))
    assert sum(done.sum() for _, _, done in first) > 3
    assert sim.log() == other.log()


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_both_learners_train_and_resume_exactly(tmp_path, learner):
    line = (*LINE, "--learner", learner)
    assert main([*line, "--max-iterations", "2", "--log-dir", str(tmp_path / "whole")]) == 0
    assert main([*line, "--max-iterations", "1", "--log-dir", str(tmp_path / "half")]) == 0
    half = run_dir.find_checkpoint(tmp_path / "half", "latest")
    manifest = json.loads((half.parent / "manifest.json").read_text())
    assert manifest["motions"]["clips"] == ["squat"]
    assert not any(change.startswith("motions.") for change in manifest["overrides"])
    go_on = ("train", "--resume", str(half), "--max-iterations", "1", "--logger", "none", "--threads", "1")
    assert main([*go_on, "--log-dir", str(tmp_path / "half")]) == 0
    ends = [run_dir.find_checkpoint(tmp_path / name, "latest") for name in ("whole", "half")]
    assert [path.name for path in ends] == ["model_2.pt"] * 2
    one, other = (run_dir.load_checkpoint(path) for path in ends)
    for kind in one:
        if kind.endswith("state_dict"):
            for name, tensor in one[kind].items():
                if hasattr(tensor, "equal"):
                    assert tensor.equal(other[kind][name]), (kind, name)


def test_a_train_config_changes_options_of_the_training_alone(tmp_path, monkeypatch):
    seen = []
    make_env = polypod.make

    def noted(*words, **more):
        env = make_env(*words, **more)
        seen.append(dict(env.sim.terms.options))
        return env

    monkeypatch.setattr(polypod, "make", noted)
    mine = tmp_path / "mine.toml"
    narrow = "motions.rewards.motion_relative_body_position_error_exp.std=0.05"
    mine.write_text(f'extends = "tracking"\n[run]\ntask_changes = ["{narrow}"]\n')
    line = (*LINE, "--train-config", str(mine), "--max-iterations", "1", "--log-dir", str(tmp_path))
    assert main(line) == 0
    of_training = seen[0]["rewards"]["motion_relative_body_position_error_exp"]["std"]
    run = run_dir.find_checkpoint(tmp_path, "latest").parent
    of_run = json.loads((run / "manifest.json").read_text())["motions"]
    assert (of_training, of_run["rewards"]["motion_relative_body_position_error_exp"]["std"]) == (0.05, 0.15)
    mine.write_text('extends = "tracking"\n[run]\ntask_changes = ["motions.look_ahead=[1]"]\n')
    assert main(line) == 2


def test_a_run_is_evaluated_and_exported_by_its_manifest_alone(tmp_path, capsys):
    assert main([*LINE, "--max-iterations", "1", "--log-dir", str(tmp_path)]) == 0
    checkpoint = str(run_dir.find_checkpoint(tmp_path, "latest"))
    figures = tmp_path / "figures.json"
    line = ["motions", "eval", checkpoint, "--robots", "unitree_g1", "--episodes", "2", "--threads", "1"]
    assert main([*line, "--json", str(figures)]) == 3  # nothing was learnt
    found = json.loads(figures.read_text())["unitree_g1"]["squat"]
    assert found["episodes"] == 2
    assert found["failed"] == 1.0
    assert "left_knee_link" in found["links_m"]
    pytest.importorskip("onnxruntime")
    pytest.importorskip("mujoco")
    assert main([*line, "--json", str(figures), "--mujoco"]) == 3
    theirs = json.loads(figures.read_text())["unitree_g1"]["squat"]
    assert theirs["base_m"][0] == pytest.approx(found["base_m"][0], rel=0.1)
    assert main(["export", "--checkpoint", checkpoint, "--robots", "unitree_g1", "--out", str(tmp_path / "out")]) == 0
    contract = json.loads((tmp_path / "out" / "policy_unitree_g1.json").read_text())
    inputs = {entry["name"] for entry in contract["inputs"]}
    assert {"motion_command", "motion_phase", "motion_anchor_pos_b", "motion_anchor_ori_b"} <= inputs
    capsys.readouterr()


def test_options_are_checked_by_name():
    for change, message in [
        ("motions.clip=[]", "unknown field `clip`"),
        ("motions.rewards.dance={weight=1.0, std=1.0}", r"motions\.rewards\.dance: no such term"),
        ("motions.reset.pose_range.up=[0.0, 1.0]", r"motions\.reset\.pose_range\.up"),
        ("motions.sampling.bin_s=0.0", r"motions\.sampling\.bin_s"),
        ('motions.clips=["dance"]', "cannot read the motion dance"),
    ]:
        with pytest.raises(_core.ConfigError, match=message):
            make(change)
    with pytest.raises(_core.ConfigError, match="tracks no motions; leave it out"):
        polypod.make("velocity_flat", 8, overrides=[SQUAT])
    assert options().clips == ["squat", "wave", "turn", "walk"]
    tasks = {alias for task in _core.tasks() for alias in task["aliases"]}
    assert {TASK, f"{TASK}_measured"} <= tasks
