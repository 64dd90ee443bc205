"""`lab.speed` measures what docs/performance.md shows besides `polypod bench`."""

import json

import pytest

from lab.speed import walking
from lab.speed.__main__ import main
from polypod import _core, provenance
from polypod.bench import physics, sampling, steps

TINY = 'extends = "quick"\n[run]\nnum_envs = 32\nnum_steps_per_env = 4\nmax_iterations = 2\n'


def test_scaling_has_a_row_for_every_figure(tmp_path, monkeypatch, capsys) -> None:
    """One control step for each figure: those of the docs are rates of the machine."""
    monkeypatch.setattr(
        sampling, "rates", lambda samples, *_: {name: [float(sample())] for name, sample in samples.items()}
    )
    monkeypatch.setattr(steps, "SETTLE", 1)
    monkeypatch.setattr(physics, "SETTLE", 1)
    plot, file = tmp_path / "speed.png", tmp_path / "speed.json"
    assert main(["scaling", "--num-envs", "16", "--largest", "4", "--json", str(file), "--plot", str(plot)]) == 0
    result = json.loads(file.read_text())
    assert set(result["scaling_robots"]) == {"1", "2", "4", "8"}
    assert set(result["by_robot"]) == set(_core.task_robots("velocity_flat"))
    assert plot.stat().st_size > 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    for words in (
        "flat control step",
        "4 envs of one robot",
        "1 threads",
        "8 different robots",
        "spot",
        "flat, episodes",
    ):
        assert any(row.startswith(f"| {words}") for row in rows)


def test_kinds_together_stand_beside_kinds_alone(tmp_path, capsys) -> None:
    """The mean is the harmonic one: of costs, not of rates."""
    file = tmp_path / "kinds.json"
    arguments = ("--robots", "bolt,unitree_g1", "--num-envs", "32", "--step-threads", "1", "--json", str(file))
    assert main(["kinds", *arguments]) == 0
    result = json.loads(file.read_text())
    rates = result["by_kind"]
    assert result["joints"] == {"bolt": 6, "unitree_g1": 29}
    assert result["one_by_one"] == pytest.approx(2 / (1 / rates["bolt"] + 1 / rates["unitree_g1"]))
    assert result["share"] == pytest.approx(result["mixed"] / result["one_by_one"])
    assert "| all kinds in one batch |" in capsys.readouterr().out


@pytest.mark.parametrize("kinds", ["bolt", "bolt,bolt", "bolt,nobody"])
def test_kinds_are_two_known_ones_or_more(kinds, capsys) -> None:
    assert main(["kinds", "--robots", kinds, "--num-envs", "4"]) == 2
    error = capsys.readouterr().err
    assert "nobody" in error or "two different robots" in error


def test_walks_are_looked_for_at_intervals(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(walking, "INTERVAL", 1)
    monkeypatch.setattr(walking, "ENVS_PER_ROBOT", 1)
    (tmp_path / "tiny.toml").write_text(TINY)
    arguments = (
        "--train-config",
        "tiny.toml",
        "--robots",
        "unitree_go1",
        "--seeds",
        "1",
        "--json",
        "walk.json",
        "--plot",
        "walk.png",
    )
    assert main(["walk", *arguments]) == 0
    shown = capsys.readouterr().out
    content = json.loads((tmp_path / "walk.json").read_text())
    (run,) = content["runs"]
    assert (run["seed"], run["walked"]) == (42, False)
    assert [point["samples"] for point in run["curve"]] == [128, 256]
    last = run["curve"][1]
    assert last["walk"] == 0
    # the second figure is that of a robot which stands still
    assert last["error_vel_xy"] > 0.5 * last["still_error_vel_xy"] > 0.0
    assert 0.0 < last["still_error_vel_yaw"] < 1.0
    assert last["error_vel_yaw"] > 0.0
    assert content["walks"] == walking.BOUNDS
    assert run["startup_s"] > 0.0
    assert set(run["watt_hours"]) <= {"processors"}
    assert content["robots"] == ["unitree_go1"]
    assert (tmp_path / "walk.png").stat().st_size > 0
    assert "| 42 | no | 0.0 |" in shown
    assert "| worst error (m/s) | still | worst yaw error (rad/s) | still | least turn |" in shown


def test_energy_has_a_column_where_every_run_tells_it():
    point = {"walk": 1, "error_vel_xy": 0.1, "turn_reached": 0.9, "drift_xy": 0.0, "fall_rate": 0.0}
    point |= {"still_error_vel_xy": 0.4, "error_vel_yaw": 0.1, "still_error_vel_yaw": 0.3}
    runs = [
        {"seed": seed, "walked": True, "samples": 2e6, "seconds": 60.0, "startup_s": 5.0, "curve": [point]}
        | {"watt_hours": {"processors": 1.5, "GPUs": 2.0}}
        for seed in (0, 1)
    ]
    result = {"learner": "native", "device": "cpu", "runs": runs, "train_config": "tiny", "threads": 2, "simd": "avx2"}
    result["measured"] = provenance.measured()
    text = walking.table(result)
    assert "| s | with start-up, s | Wh, GPUs and processors | worst error" in text
    assert "| 0 | yes | 2.0 | 60 | 65 | 3.50 | 0.100 |" in text
    assert "| mean and deviation of 2 | | 2.0 ± 0.0 | 60.0 ± 0.0 | 65.0 ± 0.0 | 3.5 ± 0.0 |" in text
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert len(widths) == 1
    runs[1]["watt_hours"] = {}
    assert "Wh" not in walking.table(result)
