"""`lab.zero_shot` measures the robots of a folder as `eval` does, and goes on after a refusal."""

import json
import sys

import pytest
from rich.console import Console

from common import ROOT
from lab import zero_shot
from polypod import bodies, bundled
from polypod.evaluation import evaluate_checkpoint

STEPS = 30


def test_every_file_has_a_line(tmp_path):
    bodies.generate(tmp_path / "drawn", 2, seed=3, kinds=["quadruped", "biped"])
    folder = tmp_path / "brought"
    folder.mkdir()
    text = (ROOT / "assets/robots/unitree_go1/robot.urdf").read_text()
    (folder / "Go 1.urdf").write_text(text)
    (folder / "table.urdf").write_text('<robot name="table"><link name="top"/></robot>')
    robots = [
        robot for each in (folder, tmp_path / "drawn") for robot in zero_shot.robots_of(each, tmp_path / "drafts")
    ]
    assert [robot.name for robot in robots] == ["go_1", "table", "body_biped_1", "body_quadruped_0"]
    checkpoint = bundled.checkpoint("quadruped")
    found = zero_shot.measure(checkpoint, robots, num_envs=4, steps=STEPS, threads=1)
    assert "table.urdf" in found["table"]["refused"]
    assert found["go_1"]["stands"] is True
    alone = evaluate_checkpoint(
        checkpoint, [robots[-1].source], task=zero_shot.TASK, num_envs=4, steps=STEPS, seed=0, threads=1
    )
    (figures,) = alone.robots.values()
    assert found["body_quadruped_0"]["walking"]["error_vel_xy"] == figures.walking.error_vel_xy
    assert found["body_quadruped_0"]["distance"]["distance"] > 0.0
    console = Console(width=200)
    with console.capture() as printed:
        zero_shot.table(found).print(console)
    _, *lines = printed.get().splitlines()
    assert [line.split()[0] for line in lines] == [robot.name for robot in robots]
    assert [line.split()[0] for line in lines if line.rstrip().endswith("refused")] == ["table"]


def test_the_program(tmp_path, monkeypatch, capsys):
    bodies.generate(tmp_path / "drawn", 1, seed=3, kinds=["quadruped"])
    monkeypatch.setattr(zero_shot, "measure", lambda *_, **__: {"one": {"refused": "why"}, "two": {"refused": "too"}})
    line = [str(tmp_path / "drawn"), "--checkpoint", "quadruped", "legged", "--json", str(tmp_path / "found.json")]
    monkeypatch.setattr(sys, "argv", ["zero_shot", *line])
    zero_shot.main()
    printed = capsys.readouterr().out
    assert "legged: 0 of 2 walk" in printed
    assert "one: why" in printed
    assert set(json.loads((tmp_path / "found.json").read_text())) == {"quadruped", "legged"}


def test_two_robots_of_one_name_are_refused(tmp_path, monkeypatch, capsys):
    """The draft of the second one would take the place of the first one's."""
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "robot.urdf").write_text('<robot name="table"><link name="top"/></robot>')
    monkeypatch.setattr(sys, "argv", ["zero_shot", str(tmp_path / "one"), str(tmp_path / "two")])
    with pytest.raises(SystemExit):
        zero_shot.main()
    assert "several files name their robot robot; rename all but one" in capsys.readouterr().err
