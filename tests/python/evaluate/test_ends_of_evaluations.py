"""Endless evaluations are refused before they fill the memory."""

import pytest

from common import FLAT_POLICY

CHECKPOINT = ("--checkpoint", str(FLAT_POLICY), "--robots", "spot")
ENDLESS = ("--set", "sim.episode_length_s=1e9")


@pytest.mark.parametrize(
    "arguments",
    [
        ("eval", *CHECKPOINT, "--num-envs", "8", "--steps", "1", "--episodes", "2147483648"),
        ("eval", *CHECKPOINT, "--num-envs", "8", "--commands", "task", *ENDLESS),
        ("sim2sim", *CHECKPOINT, "--num-envs", "1", "--commands", "task", *ENDLESS),
    ],
    ids=["episodes", "eval", "sim2sim"],
)
def test_steps_without_end_are_refused(cli, arguments):
    done = cli(*arguments)
    assert done.returncode == 2
    assert "--steps" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_training_of_episodes_without_end_is_evaluated(cli):
    done = cli("train", "--logger", "none", "--max-iterations", "1", "--num-envs", "64", "--robots", "spot", *ENDLESS)
    assert done.returncode == 0, done.stderr
    assert "64 envs, 20 s, a new command every 5 s" in done.stdout
    assert "0 of 1 walk" in done.stdout
