"""A run is found by its name or by the end of it, wherever a command takes a checkpoint."""

from pathlib import Path

import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY
from polypod import runs
from polypod.runs import run_dir

NAMES = [
    "2026-01-01_10-00-00_two",
    "2026-01-02_10-00-00_fifty_two",
    "2026-01-03_10-00-00_same",
    "2026-01-04_10-00-00_same",
    "2026-01-05_10-00-00",
    "2026-01-06_10-00-00_only-2",
]


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Runs of two experiments in `logs`."""
    monkeypatch.chdir(tmp_path)
    for place, name in enumerate(NAMES):
        run = Path("logs") / "rsl_rl" / f"experiment_{place % 2}" / name
        run.mkdir(parents=True)
        (run / "manifest.json").write_text("{}")
        for number in (5, 20):
            (run / f"model_{number}.pt").touch()
    return Path("logs")


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ("two", 0),
        ("fifty_two", 1),
        ("2026-01-02_10-00-00_fifty_two", 1),
        ("only-2", 5),
        ("10-00-00", 4),
        ("2026-01-05_10-00-00", 4),
    ],
)
def test_the_end_of_a_name_is_enough(logs, given, place):
    found = run_dir.find_checkpoint(logs, given)
    assert (found.parent.name, found.name) == (NAMES[place], "model_20.pt")
    assert runs.resolve(Path(given)) == found
    assert runs.resolve(Path(given), logs) == found


def test_a_run_s_folder_is_its_last_checkpoint(logs):
    folder = logs / "rsl_rl" / "experiment_0" / NAMES[0]
    assert runs.resolve(folder) == folder / "model_20.pt"
    # neither a folder of logs nor one that is called like a policy is a run
    assert runs.resolve(logs) == logs
    Path("flat").mkdir()
    assert runs.resolve(Path("flat")) == FLAT_POLICY


def test_what_several_runs_end_in_is_no_name(logs):
    for find in (lambda: run_dir.find_checkpoint(logs, "same"), lambda: runs.resolve(Path("same"))):
        with pytest.raises(polypod.ConfigError, match="end of several runs") as caught:
            find()
        assert NAMES[2] in str(caught.value)
        assert NAMES[3] in str(caught.value)


@pytest.mark.parametrize("given", ["wo", "nothing", "_two", "TWO", "-2"])
def test_parts_of_words_are_no_names(logs, given):
    with pytest.raises(polypod.ConfigError, match="neither a checkpoint nor a run"):
        run_dir.find_checkpoint(logs, given)
    assert runs.resolve(Path(given)) == Path(given)


def test_files_and_bundled_policies_come_first(logs):
    run = logs / "rsl_rl" / "experiment_0" / "2026-01-07_10-00-00_flat"
    run.mkdir()
    (run / "manifest.json").write_text("{}")
    (run / "model_1.pt").touch()
    assert runs.resolve(Path("flat")).name == FLAT_POLICY.name
    Path("two").touch()
    assert runs.resolve(Path("two")) == Path("two")


@pytest.mark.parametrize(
    "line",
    [
        ("train", "--init", "same"),
        ("train", "--resume", "same"),
        ("eval", "--checkpoint", "same"),
        ("export", "--checkpoint", "same"),
        ("play", "--checkpoint", "same", "--headless"),
        ("sim2sim", "--checkpoint", "same"),
        ("film", "walk", "x.gif", "--checkpoint", "same"),
    ],
)
def test_every_command_lists_the_runs_that_are_meant(logs, capsys, line):
    assert polypod.cli.main(line) == 2
    said = capsys.readouterr().err
    assert "pass one of these" in said
    assert said.count("\n") == 1
