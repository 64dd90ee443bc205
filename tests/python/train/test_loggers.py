"""Curves go to wandb and neptune through rsl_rl's writers, where the user has them."""

import sys
import types

import pytest

LINE = ("train", "--num-envs", "16", "--robots", "spot", "--max-iterations", "1", "--set", "sim.episode_length_s=0.4")
LINE += ("--set", "train.run.num_steps_per_env=24")


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_wandb(cli, monkeypatch, tmp_path, learner):
    """A stand-in for the package records what it is told."""
    from rsl_rl.utils import wandb_log_writer

    told, calls = {}, []
    config = types.SimpleNamespace(update=lambda values: calls.append(("config", values)))
    stand_in = types.SimpleNamespace(
        init=lambda **options: calls.append(("init", options)),
        log=lambda values, step: told.update(values),
        finish=lambda: calls.append(("finish", {})),
        config=config,
    )
    monkeypatch.setattr(wandb_log_writer, "wandb", stand_in)
    done = cli(*LINE, "--logger", "wandb", "--log-project", "walks", "--learner", learner)
    assert done.returncode == 0, done.stderr
    assert calls[0][1]["project"] == "walks"
    assert calls[-1][0] == "finish"
    assert {"Train/mean_reward", "Loss/value", "Perf/total_fps", "Episode_Reward/spot/base_motion"} & told.keys()
    assert any(key.startswith("Episode_Reward/spot/") for key in told)
    assert list(tmp_path.glob("logs/rsl_rl/*/*/events.out.tfevents*"))


@pytest.mark.parametrize("service", ["wandb", "neptune"])
def test_a_missing_package_is_named(cli, monkeypatch, tmp_path, service):
    monkeypatch.setitem(sys.modules, service, None)
    from rsl_rl.utils import neptune_log_writer, wandb_log_writer

    monkeypatch.setattr(wandb_log_writer, "wandb", None)
    monkeypatch.setattr(neptune_log_writer, "neptune", None)
    done = cli(*LINE, "--logger", service)
    assert done.returncode == 2
    assert f"--logger {service} needs the package {service}: pip install {service}" in done.stderr


def test_a_missing_account_is_named(cli, monkeypatch):
    from rsl_rl.utils import neptune_log_writer

    monkeypatch.setattr(neptune_log_writer, "neptune", types.SimpleNamespace())
    monkeypatch.delenv("NEPTUNE_API_TOKEN", raising=False)
    done = cli(*LINE, "--logger", "neptune")
    assert done.returncode == 2
    assert "NEPTUNE_API_TOKEN" in done.stderr
