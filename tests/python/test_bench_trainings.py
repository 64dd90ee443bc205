"""`polypod bench --learner` and `--walk` train what they say, and say what came of it."""

import json

from polypod.bench import walking

TINY = 'extends = "quick"\n[run]\nnum_envs = 32\nnum_steps_per_env = 4\nmax_iterations = 2\n'


def test_learners_are_timed_in_turn(cli, tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    finished = cli("bench", "--learner", "--train-config", "tiny.toml", "--json", "times.json")
    assert finished.returncode == 0, finished.stderr
    result = json.loads((tmp_path / "times.json").read_text())
    assert result["samples"] == 128
    assert {"native", "rsl_rl"} <= result["learners"].keys()
    for name, row in result["learners"].items():
        assert row["iteration_s"] == row["collection_s"] + row["update_s"] > 0.0
        assert f"| {name} |" in finished.stdout


def test_walks_are_looked_for_at_intervals(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(walking, "INTERVAL", 1)
    monkeypatch.setattr(walking, "ENVS_PER_ROBOT", 1)
    (tmp_path / "tiny.toml").write_text(TINY)
    arguments = ("--train-config", "tiny.toml", "--seeds", "1", "--json", "walk.json", "--plot", "walk.png")
    finished = cli("bench", "--walk", *arguments)
    assert finished.returncode == 0, finished.stderr
    (run,) = json.loads((tmp_path / "walk.json").read_text())["runs"]
    assert (run["seed"], run["walked"]) == (42, False)
    assert [point["samples"] for point in run["curve"]] == [128, 256]
    assert run["curve"][1]["error_vel_xy"] > walking.WALKS["error_vel_xy"]
    assert (tmp_path / "walk.png").stat().st_size > 0
    assert "| 42 | no | 0.0 |" in finished.stdout
