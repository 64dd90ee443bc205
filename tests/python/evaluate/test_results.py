"""Tables and curves come from the files of trainings and evaluations; none is typed."""

import dataclasses
import json
import lzma
import math
import tarfile
from pathlib import Path

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

import polypod
from common import ROOT
from lab import results
from lab.results import pictures, runs
from lab.results.__main__ import main
from polypod import provenance
from polypod.evaluation import Evaluation, RobotResult, TileResult, Walking, evaluate, walking
from polypod.evaluation.results import finite

ROBOTS = ["anymal_d", "spot"]
TASK, PLAY = "Velocity-Flat-Universal-v0", "Velocity-Flat-Universal-Play-v0"


def stand(observations):
    return np.zeros((len(observations), 12), dtype=np.float32)


def robot(**values):
    numbers = {field.name: 0.5 for field in dataclasses.fields(RobotResult) if field.type is float}
    return RobotResult(**{**numbers, "episodes": 100, **values})


def evaluation(robots, trained_on=ROBOTS, **values):
    origin = {"file": "model_9.pt", "iteration": 9, "task": TASK, "robots": list(trained_on), "seed": 1}
    fields = {
        "task": PLAY,
        "num_envs": 50,
        "episodes": 2,
        "steps": None,
        "seed": 3,
        "overrides": [],
        "duration_s": 20.0,
        "randomized": False,
        "grid": None,
        "robots": robots,
        "checkpoint": origin,
    }
    return Evaluation(**{**fields, **values})


def write_run(folder, evaluations=None, robots=ROBOTS, curves=None, seed=1):
    folder.mkdir(parents=True)
    manifest = {
        "task": "T-v0",
        "robots": list(robots),
        "seed": seed,
        "num_envs": 1024,
        "command": f"polypod train --seed {seed}",
        "git": {"commit": "0123456", "dirty": False},
        "train_config": {"run": {"num_steps_per_env": 24}},
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    for name, each in (evaluations or {}).items():
        (folder / f"{name}.json").write_text(json.dumps(each.as_dict()))
    if curves:
        writer = SummaryWriter(log_dir=str(folder))
        for tag, values in curves.items():
            for iteration, value in enumerate(values):
                writer.add_scalar(tag, value, iteration)
        writer.close()


def rows_of(text, heading):
    """The cells of the first table after a line that begins with `heading`, by the first cell."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(heading))
    table = []
    for line in lines[start:]:
        if line.startswith("|"):
            table.append([cell.strip() for cell in line.strip("|").split("|")])
        elif table:
            break
    return {row[0]: row[1:] for row in table}


def test_seeds_of_a_group_become_a_mean_and_an_interval(tmp_path):
    for seed, error in enumerate((0.10, 0.20, 0.30)):
        bad = robot(error_vel_xy=error, still_error_vel_yaw=0.31, fall_rate=0.01)
        found = evaluation({"anymal_d": bad, "spot": robot(error_vel_xy=0.2)})
        write_run(tmp_path / "plain" / f"seed{seed}", {"result": found}, seed=seed)
    text, _ = results.write(results.read(tmp_path))
    table = rows_of(text, "Group plain, 3 policies")
    assert table["robot"][1:3] == ["velocity error (m/s)", "still (m/s)"]
    assert table["robot"][3:5] == ["yaw rate error (rad/s)", "still (rad/s)"]
    # 4.3027 * 0.1 / sqrt(3)
    assert table["anymal_d"][:2] == ["300", "0.200 ±0.248"]
    assert table["anymal_d"][4:6] == ["0.310 ±0.000", "1.0% ±0.0%"]
    assert table["spot"][1] == "0.200 ±0.000"
    assert "polypod eval --checkpoint model_9.pt --num-envs 50 --episodes 2 --seed 3 --commands task" in text
    assert "more of plain" not in text  # three times the same command
    assert rows_of(text, "### Trainings")["plain"] == ["`T-v0`", "2", "3", "0, 1, 2", "9", "0", "-", "0123456"]


def walker(**values):
    figures = {
        **dict.fromkeys(walking.FIGURES, 0.0),
        **{"still_error_vel_xy": 0.46, "turn_reached": 0.9, "side_reached": 0.8, "drift_xy": 0.012, "drift_yaw": 0.034},
    }
    return Walking(**{"episodes": 100, "duration_s": 20.0, "kinds": walking.KINDS, **figures, **values})


def test_walking_is_judged_where_the_files_hold_it(tmp_path):
    """Walking has separate tables, next to those of evaluations with commands of the task."""
    for seed, turn in enumerate((0.9, 0.5)):
        found = {"anymal_d": robot(walking=walker()), "spot": robot(walking=walker(turn_reached=turn))}
        judged = evaluation(found, commands="walking")
        old = evaluation({name: robot() for name in ROBOTS})
        write_run(tmp_path / "plain" / f"seed{seed}", {"judged": judged, "old": old}, seed=seed)
    text, _ = results.write(results.read(tmp_path))
    judged, old = text.split(f"### `{PLAY}`")[1:]
    assert "a new command every 5 s, with pure turns, side-steps and stops" in judged.replace("\n", " ")
    table = rows_of(judged, "Group plain")
    assert table["robot"][-5:] == ["turn", "side-step", "drift (m/s)", "drift (rad/s)", "walks"]
    assert table["anymal_d"][-4:] == ["80% ±0%", "0.012 ±0.000", "0.034 ±0.000", "2 of 2"]
    assert table["spot"][-1] == "1 of 2"
    assert "--commands" not in judged
    assert "commands as the task draws them" in old
    assert rows_of(old, "Group plain")["robot"][-1] == "foot slip (m/s)"
    assert "--seed 3 --commands task" in old


def test_groups_stand_side_by_side_and_conditions_apart(tmp_path):
    for group, error in (("plain", 0.4), ("descriptor", 0.1)):
        quiet = evaluation({name: robot(error_vel_xy=error) for name in ROBOTS})
        pushed = evaluation({name: robot(error_vel_xy=error + 0.1) for name in ROBOTS}, randomized=True)
        write_run(tmp_path / group / "one", {"quiet": quiet, "pushed": pushed})
    text, _ = results.write(results.read(tmp_path))
    pushed, quiet = text.split(f"### `{PLAY}`")[1:3]
    assert "no noise, no pushes" in quiet
    assert "randomisation as in training" in pushed
    for part, errors in ((quiet, ["0.100", "0.400"]), (pushed, ["0.200", "0.500"])):
        assert "falls per episode of descriptor (1 policy), plain (1 policy):" in part.replace("\n", " ")
        table = rows_of(part, "Velocity error")
        assert table["robot"][::3] == ["descriptor: err xy", "plain: err xy"]
        assert table["spot"][::3] == errors


def test_robots_that_were_left_out_stand_apart(tmp_path):
    """Two runs of one group, each without one robot.

    Each robot's row is that of the run that never saw it.
    """
    for out, falls in (("spot", 0.2), ("anymal_d", 0.4)):
        trained_on = [name for name in ROBOTS if name != out]
        found = {name: robot(fall_rate=falls if name == out else 0.0) for name in ROBOTS}
        write_run(tmp_path / "leave_one_out" / out, {"result": evaluation(found, trained_on)}, robots=trained_on)
    text, _ = results.write(results.read(tmp_path))
    unseen = rows_of(text, "Robots that the policy was not trained on")
    assert unseen["spot"][0] == "80%"
    assert unseen["anymal_d"][0] == "60%"
    assert rows_of(text, "Group leave_one_out")["spot"][5] == "0.0%"


def test_specialists_are_what_the_others_are_compared_with(tmp_path):
    for name in ROBOTS:
        found = evaluation({name: robot(tracking_reward=0.8)}, [name])
        write_run(tmp_path / "specialists" / name, {"result": found}, robots=[name])
    both = {"anymal_d": robot(tracking_reward=0.76), "spot": robot(tracking_reward=0.88)}
    write_run(tmp_path / "universal" / "one", {"result": evaluation(both)})
    text, _ = results.write(results.read(tmp_path))
    table = rows_of(text, "Tracking reward beside")
    assert table == {"robot": ["universal / specialists"], "---": ["---"], "anymal_d": ["95.0%"], "spot": ["110.0%"]}


def test_success_on_tiles(tmp_path):
    def on(*shares):
        tiles = [TileResult(level, 10, share, 0.0) for level, share in enumerate(shares)]
        return robot(terrain={"boxes": tiles})

    found = evaluation({"anymal_d": on(1.0, 0.5), "spot": on(0.8, 0.1)})
    write_run(tmp_path / "rough" / "one", {"result": found})
    text, _ = results.write(results.read(tmp_path))
    assert rows_of(text, "Success by type")["anymal_d"] == ["75%", "75%"]
    assert rows_of(text, "Success by level")["1"] == ["30%", "30%"]


def error_curve(at, high=0.8, low=0.1, length=40):
    """High up to iteration `at`, low from there on."""
    return [high if iteration < at else low for iteration in range(length)]


def test_iterations_to_a_score_are_counted_on_the_smoothed_curve(tmp_path):
    tag = "Metrics/spot/error_vel_xy"
    write_run(tmp_path / "fine_tuned" / "one", curves={tag: error_curve(4)})
    for seed, at in ((0, 20), (1, 24), (2, 99)):
        write_run(tmp_path / "scratch" / f"seed{seed}", curves={tag: error_curve(at)}, seed=seed)
    found = results.read(tmp_path)
    text, _ = results.write(found, score=0.46)
    # the mean of 0.8 and 0.1 is below 0.46 with as many of each: four of eight, five of ten after
    # 20 and 24 iterations
    assert rows_of(text, "### Iterations to 0.46 m/s")["spot"] == ["0.460", "8", "27 (2 of 3)"]
    text, _ = results.write(found, baseline="scratch")
    goal = (0.1 + 0.1 + 0.8) / 3
    table = rows_of(text, "### Iterations to the error that scratch ends with")
    assert table["spot"][0] == f"{goal:.3f}"
    assert table["spot"][1] == "11"
    with pytest.raises(polypod.ConfigError, match="no group with curves; use one of fine_tuned, scratch"):
        results.write(found, baseline="scrach")


def test_smoothing_and_reaching_by_hand():
    curve = runs.Curve(np.arange(1.0, 6.0), np.array([5.0, 3.0, 1.0, 1.0, 7.0]))
    np.testing.assert_allclose(runs.smoothed(curve, 2).values, [5.0, 4.0, 2.0, 1.0, 4.0])
    assert runs.reached(runs.smoothed(curve, 2), 2.0) == 3.0
    thinned = runs.Curve(np.array([1.0, 2.0, 9.0, 11.0]), np.array([4.0, 2.0, 8.0, 6.0]))
    np.testing.assert_allclose(runs.smoothed(thinned, 2).values, [4.0, 3.0, 8.0, 6.0])
    np.testing.assert_allclose(runs.smoothed(thinned, 3).values, [4.0, 3.0, 8.0, 7.0])
    assert math.isnan(runs.reached(curve, 0.5))
    assert runs.final(curve) == 7.0


def test_curves_of_different_batches_share_an_axis_of_samples():
    short = runs.Curve(np.array([1.0, 2.0, 3.0]), np.array([3.0, 2.0, 1.0]))
    long = runs.Curve(np.array([1.0, 2.0]), np.array([3.0, 1.0]))
    samples, mean, low, high = runs.mean_curve([short, long], [10.0, 20.0])
    assert (samples[0], samples[-1]) == (20.0, 30.0)
    np.testing.assert_allclose([mean[0], low[0], high[0]], [2.5, 2.0, 3.0])
    np.testing.assert_allclose([mean[-1], low[-1], high[-1]], [1.5, 1.0, 2.0])


def comparison(name, falls):
    figures = {"error_vel_xy": 0.1, "error_vel_yaw": 0.05, "fall_rate": 0.0, "episode_length_s": 20.0}
    return {
        "command": f"polypod sim2sim --robots {name}",
        "task": PLAY,
        "envs_per_robot": 64,
        "seed": 0,
        "duration_s": 20.0,
        "mujoco_version": "4.0.0",
        "physics": {"dt": 0.005, "integrator": "implicitfast", "friction": 0.8, "soft_contact": False},
        "robots": {name: {"polypod": figures, "mujoco": {**figures, "fall_rate": falls}, "transfers": falls <= 0.05}},
    }


def test_comparisons_with_mujoco_of_several_files_are_one_table(tmp_path):
    for name, falls in (("spot", 0.047), ("anymal_d", 0.25)):
        (tmp_path / f"{name}.json").write_text(json.dumps(comparison(name, falls)))
    text, _ = results.write(results.read(tmp_path))
    table = rows_of(text, "### polypod beside MuJoCo")
    assert table["spot"] == ["0.100", "0.100", "0.050", "0.050", "0.0%", "4.7%", "yes"]
    assert table["anymal_d"][-2:] == ["25.0%", "no"]
    assert "polypod sim2sim --robots anymal_d\n# 1 more of robots, likewise\n```" in text
    assert "its planar error there is at most 0.1 m/s above" in text.replace("\n", " ")


def test_comparisons_with_mujoco_say_by_what_a_robot_transfers(tmp_path):
    content = comparison("spot", 0.0)
    figures = finite(dataclasses.asdict(walker(drift_xy=math.nan)))
    for engine in ("polypod", "mujoco"):
        content["robots"]["spot"][engine] = {**content["robots"]["spot"][engine], "walking": figures}
    (tmp_path / "spot.json").write_text(json.dumps(content))
    text, _ = results.write(results.read(tmp_path))
    assert "A robot transfers if it walks in MuJoCo." in text.replace("\n", " ")
    table = rows_of(text, "### polypod beside MuJoCo")
    assert table["spot"][4:] == ["90%", "90%", "-", "-", "0.0%", "0.0%", "yes"]


def test_the_command_writes_document_and_pictures(tmp_path, capsys):
    folder = tmp_path / "runs"
    curves = {f"Metrics/{name}/{metric}": error_curve(9) for name in ROBOTS for metric in ("error_vel_xy", "fall_rate")}
    write_run(folder / "plain" / "a", {"result": evaluation({name: robot() for name in ROBOTS})}, curves=curves)
    write_run(folder / "other" / "a", curves=curves, seed=2)
    (folder / "plain" / "a" / "strange.json").write_text('{"other": 1}')
    document = tmp_path / "docs" / "results.md"
    over_grid = evaluate(stand, "velocity_flat", robots=ROBOTS, num_envs=8, steps=2, grid=(2, 2, 1))
    write_run(folder / "own network" / "a", {"grid": over_grid})
    document.parent.mkdir()
    document.write_text("# Results\n\n<!-- results:begin -->\nold\n<!-- results:end -->\n\nafter\n")
    arguments = [str(folder), "--out", str(document), "--media", str(tmp_path / "docs" / "media")]
    assert main(arguments) == 0
    shown = capsys.readouterr()
    assert "strange.json is neither" in shown.err
    text = document.read_text()
    assert text.startswith("# Results\n\n<!-- results:begin -->")
    assert text.endswith("<!-- results:end -->\n\nafter\n")
    assert "\nold\n" not in text
    assert "![curves error vel xy](media/curves_error_vel_xy.png)" in text
    drawn = sorted(path.name for path in (tmp_path / "docs" / "media").iterdir())
    assert drawn == ["curves_error_vel_xy.png", "own_network_grid.png"]
    assert all((tmp_path / "docs" / "media" / name).read_bytes().startswith(b"\x89PNG") for name in drawn)
    # again: the same document
    assert main(arguments) == 0
    assert document.read_text() == text


def test_policies_for_one_robot_each_share_a_map(tmp_path, monkeypatch):
    for name in ROBOTS:
        over_grid = evaluate(stand, "velocity_flat", robots=[name], num_envs=4, steps=2, grid=(2, 2, 1))
        write_run(tmp_path / "runs" / "specialists" / name, {"grid": over_grid}, robots=[name])
    drawn = []
    monkeypatch.setattr(pictures, "picture", lambda summary, out: drawn.append((out.name, list(summary.robots))))
    assert pictures.draw(results.read(tmp_path / "runs"), tmp_path) == [tmp_path / "specialists_grid.png"]
    assert drawn == [("specialists_grid.png", ROBOTS)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is no folder and no .tar.xz"),
        ({}, "neither evaluations nor curves"),
        ({"a/b/result.json": "{"}, "cannot read"),
        ({"a/b/result.json": "[]"}, "holds no table"),
        ({"a/b/result.json": '{"task": "T", "robots": {}, "duration_s": 1.0}'}, "another version of polypod eval"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, content, message):
    folder = tmp_path / "runs"
    for name, text in (content or {}).items():
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(text)
    if content == {}:
        folder.mkdir()
    with pytest.raises(polypod.ConfigError, match=message):
        results.read(folder)


def test_a_document_needs_its_marks(tmp_path, capsys):
    write_run(tmp_path / "runs" / "a" / "b", {"result": evaluation({"spot": robot()})})
    (tmp_path / "plain.md").write_text("nothing\n")
    assert main([str(tmp_path / "runs"), "--out", str(tmp_path / "plain.md")]) == 2
    assert "results:begin" in capsys.readouterr().err


def test_the_shipped_tables_are_those_of_the_shipped_archive():
    docs = ROOT / "docs"
    found = results.read(docs / "results.tar.xz")
    assert not found.skipped
    text, _ = results.write(found)
    assert text in (docs / "results.md").read_text(), "run `python -m lab.results` as the page says"


def test_the_shipped_results_are_those_of_the_shipped_policies():
    """Every checkpoint that the document measures lies in the repository."""
    root = ROOT
    text = (root / "docs" / "results.md").read_text()
    named = {word for line in text.splitlines() for word in line.split() if word.endswith(".pt")}
    assert named
    assert all((root / name).is_file() for name in named if name.startswith("assets/"))


def test_an_archive_is_read_as_its_folder(tmp_path, capsys):
    curves = {"Metrics/spot/error_vel_xy": error_curve(9)}
    folder = tmp_path / "runs"
    write_run(folder / "plain" / "a", {"result": evaluation({"spot": robot()})}, ["spot"], curves)
    (folder / "plain" / "a" / "strange.json").write_text('{"other": 1}')
    archive = tmp_path / "results.tar.xz"
    with tarfile.open(archive, "w:xz") as file:
        file.add(folder, ".")
    found = [results.read(source) for source in (folder, archive)]
    texts = [results.write(each)[0] for each in found]
    assert texts[0] == texts[1]
    assert found[1].skipped == [Path("plain/a/strange.json")]
    assert main([str(archive)]) == 0
    assert "### Iterations to 0.25 m/s" in capsys.readouterr().out


def test_a_broken_archive_is_refused(tmp_path):
    for content in (b"no archive at all", lzma.compress(b"no tar" * 200)):
        file = tmp_path / "other.tar.xz"
        file.write_bytes(content)
        with pytest.raises(polypod.ConfigError, match="cannot unpack"):
            results.read(file)


def test_tables_say_when_where_and_with_which_commit(tmp_path):
    origin = {"date": "2026-01-31", "machine": "a machine, 2 cores, avx2", "commit": "0123456"}
    write_run(tmp_path / "plain" / "a", {"result": evaluation({"spot": robot()}, measured=origin)}, ["spot"])
    text, _ = results.write(results.read(tmp_path))
    assert "Measured on 2026-01-31, a machine, 2 cores, avx2, commit 0123456." in text.replace("\n", " ")
    now = provenance.measured()
    assert set(now) == set(origin)
    assert all(now.values())
