"""`polypod accuracy` and `lab.accuracy` print every figure; documents change between marks."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import polypod
from lab import documents
from lab.accuracy import __main__ as command
from lab.accuracy import engines, friction, sweeps
from lab.accuracy import report as whole
from lab.accuracy.bounds import BOUNDS, exceeded
from lab.accuracy.markdown import summary, tables
from polypod.accuracy import bounds as of_robots
from polypod.accuracy import motion, report, standing, statics
from polypod.accuracy.file import FileResult
from polypod.add import judge
from polypod.commands.accuracy import Accuracy
from polypod.mujoco_model import robot

BEGIN, END = documents.marks(command.MARK)
ARTICULATED = engines.Engine(
    engine="articulated",
    height=0.43,
    pitch=-0.03,
    force=1.0,
    torque=np.array([4.0, -40.0]),
    frictionless_torque=np.array([4.0, -40.0]),
    response_max=3e-3,
    response_rms=2e-4,
    drift=0.0,
    largest_step=0.05,
    steps_per_second=1e6,
)
AVIAN = dataclasses.replace(
    ARTICULATED,
    engine="avian",
    torque=np.array([5.0, -40.5]),
    frictionless_torque=np.array([4.2, -40.1]),
    response_max=4e-4,
    response_rms=6e-5,
    drift=5e-7,
    largest_step=0.02,
    steps_per_second=2e4,
)
ENGINES = engines.Engines("spot", ARTICULATED, AVIAN)
RESPONSE = motion.StepResponse("spot", True, 1e-4, 2e-3, 3e-4, 4e-3, 0)
EMPTY = whole.Report("x.y")


def test_only_the_text_between_the_marks_changes(tmp_path: Path) -> None:
    document = tmp_path / "physics.md"
    document.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    for _ in range(2):
        documents.replace(document, command.MARK, "new\n")
        assert document.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"


@pytest.mark.parametrize(
    ("document", "words"), [("notes.md", [BEGIN]), ("/dev/zero", ["/dev/zero", "MiB"])], ids=["no marks", "endless"]
)
@pytest.mark.parametrize("flag", ["--out", "--readme"])
def test_an_unfit_document_is_refused_before_anything_is_measured(
    flag: str,
    document: str,
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.md").write_text("no marks\n")
    assert command.main([flag, document]) == 2
    captured = capsys.readouterr()
    assert all(word in captured.err for word in words)
    assert captured.out == ""


def test_an_unknown_robot_is_named() -> None:
    for measure in (report.measure, whole.measure):
        with pytest.raises(polypod.UnknownNameError, match="spott"):
            measure(["spott"])


def test_every_measurement_has_its_row() -> None:
    spot = robot.load("spot")
    drop = standing.compare_drop(spot, gains=standing.FIRM)
    measured = whole.Report(
        mujoco="x.y",
        statics=[statics.compare_statics(spot, states=2)],
        responses=[RESPONSE],
        drops=[drop, dataclasses.replace(drop, gains=1.0)],
        standing=[standing.compare_standing(spot)],
        engines=[ENGINES],
        rests=[standing.SlopeRest("spot", "front", 1e-5, 2e-5)],
        sweeps=[sweeps.Sweeps("spot", dict.fromkeys(sweeps.COUNTS, 4e-3), 9e-3)],
        slides=[friction.compare_slide(0.5, 1.0)],
        slopes=[friction.compare_slope(0.5, 0.3), friction.compare_slope(0.3, 0.5)],
        fallen=[],
        files=[FileResult("spot", dtype, judge.Errors(*7 * [1e-7])) for dtype in judge.BOUNDS],
    )
    assert not measured.broken()
    text = tables(measured)
    # eight tables, three of them with two rows: both precisions, engines, drops; and the bounds of
    # ten figures
    assert text.count("| spot |") == 11 + 10
    for bound in BOUNDS:
        assert f"| {bound.quantity} |" in text
        assert (f"| {bound.quantity} |" in summary(measured)) == bound.front_page
    assert (
        "| spot | avian | 0.4300 | -0.0300 | 1.00000 | 0.50 % | 2.50 % | 0.40 | 0.060 | 0.0005 | 20 | 20000 |" in text
    )
    assert "MuJoCo x.y" in text
    assert "MuJoCo x.y" in summary(measured)


def test_every_bound_says_why_and_can_be_exceeded() -> None:
    for bound in BOUNDS:
        assert bound.reason
        assert bound.most > 0.0
        assert bound.holds(bound.most)
        assert not bound.holds(1.0001 * bound.most)
        assert not bound.holds(float("nan"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fine": 2e-3}, "spot: step responses, 0.5 ms, deviation: 2.00 mrad exceeds 1 mrad"),
        ({"coarse": 4.4e-3}, "spot: step responses, 5 ms, share of MuJoCo's own deviation: 1.10 exceeds 1"),
        ({"fine": float("nan")}, "spot: step responses, 0.5 ms, deviation: nan mrad exceeds 1 mrad"),
    ],
)
def test_the_command_fails_and_writes_nothing_where_a_figure_exceeds_its_bound(
    changes: dict[str, float],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    document = tmp_path / "README.md"
    document.write_text(before := f"{BEGIN}\nold\n{END}\n")
    spot = statics.compare_statics(robot.load("spot"), states=2)
    held = dataclasses.replace(EMPTY, statics=[spot], responses=[RESPONSE])
    late = dataclasses.replace(held, responses=[dataclasses.replace(RESPONSE, **changes)])
    monkeypatch.setattr(whole, "measure", lambda *_: late)
    assert command.main(["--readme", str(document)]) == 1
    assert document.read_text() == before
    error = capsys.readouterr().err
    assert words in error
    assert "README.md left unchanged" in error
    monkeypatch.setattr(whole, "measure", lambda *_: held)
    assert command.main(["--readme", str(document)]) == 0
    assert "| step responses, 0.5 ms | deviation | 0.10 mrad | 1 mrad |" in document.read_text()


def test_robots_that_need_a_policy_say_so(tmp_path: Path) -> None:
    """Their own configs, and those that extend one of them."""
    standing = set(robot.names(standing=True))
    for name in ("bolt", "unitree_h1", "spot", "phantomx"):
        assert robot.load(name).needs_policy == (name not in standing)
    extended = tmp_path / "hopper.toml"
    extended.write_text('extends = "bolt"\nname = "hopper"\ntitle = "Hopper"\n')
    assert robot.load(str(extended)).needs_policy


def test_a_robot_that_falls_against_its_config_is_named() -> None:
    (line,) = dataclasses.replace(EMPTY, fallen=["spot"]).broken()
    assert "spot" in line
    assert "needs_policy" in line


def test_a_drop_of_soft_legs_has_wider_bounds_at_5_ms() -> None:
    drop = standing.Drop("spot", 1.0, 1e-4, 0.4, 0.4, 0.0, 0.0, 0.4, 0.0, 0.407, 0.06)
    assert not exceeded(drop)
    assert len(exceeded(dataclasses.replace(drop, gains=standing.FIRM))) == 2
    assert len(exceeded(standing.Drop("spot", 1.0, 1e-4, 0.4, 0.4, 0.0, 0.0, 0.4, 0.0, 0.409, 0.08))) == 2


def test_the_command_of_the_wheel_shows_the_robots_tables(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rows stand in the laboratory's tables, too."""
    drop = standing.Drop("spot", 4.0, 1e-4, 0.4, 0.4, 0.0, 0.0, 0.4, 0.0, 0.4, 0.0)
    held = report.Report(
        "x.y",
        statics=[statics.compare_statics(robot.load("spot"), states=2)],
        responses=[RESPONSE],
        drops=[drop],
        standing=[standing.Standing("spot", 1.0, *[np.array([1.0])] * 2, *[np.array([[0.0, 0.0]])] * 2)],
        rests=[standing.SlopeRest("spot", "front", 1e-5, 2e-5)],
        files=[FileResult("spot", dtype, judge.Errors(*7 * [1e-7])) for dtype in judge.BOUNDS],
    )
    monkeypatch.setattr(report, "measure", lambda *_: held)
    assert Accuracy().run() == 0
    shown = capsys.readouterr().out
    assert "MuJoCo x.y. Measured on" in shown
    for bound in of_robots.BOUNDS:
        assert (f"| {bound.quantity} | {bound.measured} |" in shown) == (held.worst(bound) is not None)
    assert set(tables(whole.Report(**vars(held))).splitlines()) >= {
        row for row in shown.splitlines() if "| spot" in row
    }
    assert "bounds are kept; the nearest is that of" in shown
    late = dataclasses.replace(held, responses=[dataclasses.replace(RESPONSE, fine=2e-3)])
    monkeypatch.setattr(report, "measure", lambda *_: late)
    assert Accuracy().run() == 1
    assert "2.00 mrad exceeds 1 mrad" in capsys.readouterr().err
