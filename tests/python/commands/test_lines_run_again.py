"""Command lines that results and manifests state are read by `polypod` as they were given."""

import shlex
from pathlib import Path

from polypod import cli, text
from polypod.commands.sim2sim import Sim2sim
from polypod.commands.train import Train
from polypod.sim2sim import on_model, run
from polypod.training import session


def read(line: str, monkeypatch):
    """The command that `polypod` reads; it is not run."""
    words, found = shlex.split(line), []
    monkeypatch.setattr(cli, "_run", lambda command: found.append(command) or 0)
    assert words[0] == "polypod"
    assert cli.main(words[1:]) == 0
    return found[0]


def test_values_are_written_by_their_type():
    given = {"--a": None, "--b": False, "--c": True, "--d": 0, "--e": [1, "x y"], "--f": (1.5, 2), "--g": Path("p")}
    line = text.command_line(("polypod", "do it"), given, {"--set": ("a=1", "b=[2, 3]"), "--none": ()})
    assert line == "polypod 'do it' --c --d 0 --e '1,x y' --f 1.5 2 --g p --set a=1 --set 'b=[2, 3]'"


def test_trainings(monkeypatch):
    options = session.Options(
        task="velocity_flat", robots=["spot", "unitree_a1"], seed=0, until_walks=3, overrides=["sim.dt=0.004", "a=b c"]
    )
    command = read(options.command, monkeypatch)
    assert isinstance(command, Train)
    assert (command.task, command.robots, command.seed) == ("velocity_flat", "spot,unitree_a1", 0)
    assert (command.until_walks, command.set) == (3, ("sim.dt=0.004", "a=b c"))


def test_comparisons_with_mujoco(monkeypatch):
    options = run.Options(command=(0.5, 0.0, -0.1), soft_contact=True, steps=7, overrides=("sim.dt=0.004",))
    command = read(run.command_line(Path("flat"), ["spot"], options), monkeypatch)
    assert isinstance(command, Sim2sim)
    assert (command.robots, command.command, command.soft_contact) == ("spot", (0.5, 0.0, -0.1), True)
    assert (command.steps, command.set, command.num_envs) == (7, ("sim.dt=0.004",), 32)
    of_model = on_model.Options(differences=False, rounds=2, friction=0.5)
    command = read(on_model._command(Path("m.xml"), Path("flat"), "spot", of_model), monkeypatch)
    assert (command.model, command.differences, command.rounds) == (Path("m.xml"), False, 2)
    assert (command.friction, command.actuators, command.seed) == (0.5, "model", 0)
