"""Plays the bundled policies on makers' MuJoCo models; prints the table of docs/makers-models.md.

    .venv/bin/pip install --no-deps --target FOLDER mjlab
    .venv/bin/python -m lab.makers_models FOLDER/mjlab/.../xmls/g1.xml:unitree_g1

Arguments are files, each with polypod's robot behind a colon, and flags of the play: `--policies
flat,quadruped`, `--actuators model,policy`, `--contact asis`, `--json FILE` for all figures, a line
for each row. Episodes last 40 s: twice forward at 0.8 m/s, turn at 0.6 rad/s, left at 0.5 m/s and
stop, 5 s each.
"""

import argparse
import dataclasses
import json
import math
from pathlib import Path

from polypod import runs
from polypod.evaluation.results import finite
from polypod.sim2sim import on_model
from polypod.sim2sim.maker import Choices

EPISODES = 20
ROUNDS = 2
HEAD = ("model", "policy", "actuators", "falls", "forward", "turn", "reached", "left", "stop")


def cells(played: on_model.Played) -> list[str]:
    """Falls, and the errors of the phases; a dash for a phase that no episode reached."""
    forward, turn, left, stop = played.phases

    def known(value: float, form: str = ".2f") -> str:
        return "-" if math.isnan(value) else format(value, form)

    return [
        f"{played.figures.fall_rate:.0%}",
        known(forward.error_vel_xy),
        known(turn.error_vel_yaw),
        known(turn.reached, ".0%"),
        known(left.error_vel_xy),
        known(stop.drift),
    ]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", metavar="FILE:ROBOT")
    parser.add_argument("--policies", default="quadruped,flat,legged")
    parser.add_argument("--actuators", default="model,policy")
    parser.add_argument("--contact", default="asis")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}", flush=True)
    for entry in given.models:
        file, robot = entry.rsplit(":", 1)
        for policy in given.policies.split(","):
            options = on_model.Options(episodes=EPISODES, rounds=ROUNDS)
            stage = on_model.Stage(runs.resolve(Path(policy)), robot, options)
            show(Path(file).stem, policy, "", stage.in_polypod(unseen, None), given.json)
            for actuators in given.actuators.split(","):
                choices = Choices(actuators, given.contact)
                model = on_model.load_model(Path(file), stage.robot, None, choices)
                show(Path(file).stem, policy, actuators, stage.on(model, unseen, None), given.json)


def show(model: str, policy: str, actuators: str, played: on_model.Played, figures: Path | None) -> None:
    """Prints a row; without actuators it is that of polypod."""
    print(f"| {' | '.join((model, policy, actuators or 'polypod', *cells(played)))} |", flush=True)
    if figures is not None:
        with figures.open("a") as file:
            row = {"model": model, "policy": policy, "actuators": actuators, **finite(dataclasses.asdict(played))}
            file.write(json.dumps(row) + "\n")


def unseen(simulator: str, done: int, total: int) -> None:
    """Progress that nobody looks at."""


if __name__ == "__main__":
    main()
