"""`polypod accuracy` rewrites what stands between the marks of a document, and nothing else."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import polypod
from polypod.accuracy import friction, motion, report, robot, standing, statics
from polypod.accuracy.markdown import summary, tables


def test_only_the_text_between_the_marks_changes(tmp_path: Path) -> None:
    document = tmp_path / "physics.md"
    document.write_text(f"before\n{report.BEGIN}\nold\n{report.END}\nafter\n")
    for _ in range(2):
        report.replace_block(document, "new\n")
        assert document.read_text() == f"before\n{report.BEGIN}\nnew\n{report.END}\nafter\n"


def test_a_document_without_marks_is_refused_before_anything_is_measured(
    cli: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    (tmp_path / "notes.md").write_text("no marks\n")
    done = cli("accuracy", "--out", "notes.md")
    assert done.returncode == 2
    assert report.BEGIN in done.stderr
    assert done.stdout == ""


def test_an_unknown_robot_is_named() -> None:
    with pytest.raises(polypod.UnknownNameError, match="spott"):
        report.measure(["spott"])


def test_every_measurement_has_its_row() -> None:
    spot = robot.load("spot")
    measured = report.Report(
        mujoco="x.y",
        statics=[statics.compare_statics(spot, states=2)],
        responses=[motion.StepResponse("spot", 1e-4, 2e-4, 3e-3, 4e-3, 0)],
        drops=[standing.compare_drop(spot, gains=standing.FIRM)],
        standing=[standing.compare_standing(spot)],
        rests=[standing.SlopeRest("spot", "front", 1e-5, 2e-5)],
        slides=[friction.compare_slide(0.5, 1.0)],
        slopes=[friction.compare_slope(0.5, 0.3)],
    )
    text = tables(measured)
    assert text.count("| spot |") == 5
    assert "MuJoCo x.y" in text
    assert "MuJoCo x.y" in summary(measured)
