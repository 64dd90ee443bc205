"""Films of polypod: a walk, a training, a push, and a comparison with MuJoCo."""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from polypod import _core
from polypod.arrays import Array
from polypod.extras import package
from polypod.networks import build_actor
from polypod.networks.policies import NetworkPolicy
from polypod.play.player import Player, aligned_starts
from polypod.policy import load
from polypod.render.film import Film
from polypod.render.raster import follow, picture, render, titled
from polypod.render.scene import Frame, replay
from polypod.sim2sim import Options as Comparison
from polypod.sim2sim import compare

if TYPE_CHECKING:
    from PIL.Image import Image

MOST_PARTS = 40
"""Checkpoints of a film of a training."""
PUSH_EVERY = 1.6
"""Time between two pushes, s."""
PUSH_SHOWN = 0.4
"""Time for which the arrow of a push is seen, s."""
_MODEL = re.compile(r"model_(\d+)\.pt")


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a film."""

    checkpoint: Path
    """A policy; for the film of a training the folder of its run, or one of its checkpoints."""
    out: Path
    robots: Sequence[str] | None = None
    command: tuple[float, float, float] = (0.6, 0.0, 0.0)
    task: str | None = None
    seconds: float = 4.0
    """Duration of a walk, or of each part of a training, s."""
    parts: int = 6
    """Checkpoints of a training, the untrained network among them."""
    push: float = 1.0
    """Velocity that a push adds, m/s."""
    warm_up: float = 1.5
    """Simulated before anything is filmed, s; a training has none."""
    fps: int = 12
    size: tuple[int, int] = (640, 300)
    seed: int = 0
    threads: int | None = None
    overrides: Sequence[str] = ()


def tell(story: str, options: Options) -> None:
    """Films a story: `walk`, `training`, `push` or `mujoco`.

    Raises:
        ConfigError: for options that cannot be used, and where a package is missing.
    """
    for flag, seconds in (("--seconds", options.seconds), ("--warm-up", options.warm_up)):
        if not 0.0 <= seconds < 1e4:
            raise _core.ConfigError(f"{flag} {seconds} is not a number of seconds")
    if not 1 <= options.parts <= MOST_PARTS:
        raise _core.ConfigError(f"--parts {options.parts} is not between 1 and {MOST_PARTS}")
    parts = options.parts if story == "training" else 1
    film = Film(options.out, options.fps, options.size, parts * options.seconds)
    stories: dict[str, Callable[[Options], Iterator[Image]]] = {
        "walk": _walk,
        "training": _training,
        "push": _pushes,
        "mujoco": _beside_mujoco,
    }
    for image in stories[story](options):
        film.add(image)
    film.close()


def _walk(options: Options) -> Iterator["Image"]:
    """All robots under one command; the title names those that the policy was not trained on."""
    player = _player(options, options.checkpoint)
    strangers = [robot for robot in player.sim.robots if robot not in player.policy_robots]
    title = f"{', '.join(strangers)}: not seen in training" if strangers else ""
    for frame in _frames(player, options):
        image = picture(player, frame, options.size)
        yield titled(image, title) if title else image


def _training(options: Options) -> Iterator["Image"]:
    """Films the same robots from the same poses under a series of checkpoints.

    An untrained network comes first.
    """
    files = _checkpoints(options.checkpoint, options.parts - 1)
    last = files[-1][1]
    player = _player(options, last)
    policy = load(last)
    torch.manual_seed(options.seed)
    untrained = NetworkPolicy(build_actor(policy.manifest["policy"]).eval(), policy.manifest["policy"]["num_obs"])
    parts: list[tuple[str, NetworkPolicy]] = [("iteration 0 (untrained)", untrained)]
    parts += [(f"iteration {number}", load(file).runner()) for number, file in files]
    without = dataclasses.replace(options, warm_up=0.0)
    for title, runner in parts:
        player.use(runner)
        for frame in _frames(player, without):
            yield titled(picture(player, frame, options.size), title)


def _checkpoints(place: Path, count: int) -> list[tuple[int, Path]]:
    """Iterations and files of a run, spread evenly, the last one among them."""
    folder = place if place.is_dir() else place.parent
    found = [(int(match[1]), file) for file in folder.glob("model_*.pt") if (match := _MODEL.fullmatch(file.name))]
    if not found:
        raise _core.ConfigError(f"{folder} holds no checkpoint (model_<n>.pt); name the folder of a run")
    found.sort()
    places = np.unique(np.linspace(len(found) - 1, 0, max(1, count)).round().astype(int))
    return [found[place] for place in places] if count > 0 else found[-1:]


def _pushes(options: Options) -> Iterator["Image"]:
    """All robots are pushed, to the left and to the right in turn."""
    player = _player(options, options.checkpoint)
    if player.ground is not None:
        raise _core.ConfigError(f"{player.sim.task_name}: the film of a push is on flat ground; choose a flat --task")
    _warm_up(player, options)
    pushed, direction, count = -PUSH_SHOWN, np.zeros(3), 0
    began = player.time
    due = began + 0.5 * PUSH_EVERY
    for frame in _frames(player, dataclasses.replace(options, warm_up=0.0)):
        arrows = []
        if player.time - pushed < PUSH_SHOWN and count:
            arrows = [(robot.position[0] + [0.0, 0.0, 0.1] - direction, 0.8 * direction) for robot in frame.robots]
        camera = follow(player, frame, options.size)
        image = render(player, frame, camera, options.size, arrows=arrows)
        yield titled(image, f"pushed by {options.push:g} m/s" if arrows else "")
        if player.time >= due:
            direction = np.array([0.0, 1.0 if count % 2 else -1.0, 0.0])
            player.push(options.push * direction)
            pushed, due, count = player.time, due + PUSH_EVERY, count + 1


def _beside_mujoco(options: Options) -> Iterator["Image"]:
    """Films a policy from the same states: in polypod above, in MuJoCo below."""
    width, height = options.size
    half = (width, height // 2)
    player = _player(options, options.checkpoint)
    if player.ground is not None:
        raise _core.ConfigError(f"{player.sim.task_name}: this film is on flat ground; choose a flat --task")
    states: dict[tuple[str, str], list[Array]] = {}

    def watch(simulator: str, robot: str, qpos: Array) -> None:
        states.setdefault((simulator, robot), []).append(qpos[0].copy())

    steps = max(1, round((options.seconds + options.warm_up) / player.step_dt))
    comparison = compare(
        options.checkpoint,
        options.robots,
        Comparison(
            envs_per_robot=1,
            steps=steps,
            seed=options.seed,
            command=options.command,
            commands="task",
            overrides=(*aligned_starts(player.config), *options.overrides),
        ),
        watch=watch,
    )
    steps = min(len(rows) for rows in states.values())
    frames = {
        simulator: replay(
            player, player.sources, {robot: states[simulator, robot][:steps] for robot in player.sim.robots}
        )
        for simulator in ("polypod", "mujoco")
    }
    titles = {"polypod": "polypod", "mujoco": f"MuJoCo {comparison.mujoco_version}"}
    begin, shot = round(options.warm_up / player.step_dt), 0
    image = package("PIL.Image", "drawing pictures", "play")
    for step in range(begin, steps):
        if (step - begin) * player.step_dt * options.fps < shot - 1e-6:
            continue
        shot += 1
        camera = follow(player, frames["polypod"][step], half)
        whole: Image = image.new("RGB", (width, height))
        for row, simulator in enumerate(("polypod", "mujoco")):
            shown = render(player, frames[simulator][step], camera, half)
            whole.paste(titled(shown, titles[simulator]), (0, row * half[1]))
        yield whole


def _player(options: Options, checkpoint: Path) -> Player:
    return Player(
        checkpoint,
        options.robots,
        options.command,
        task=options.task,
        seed=options.seed,
        threads=options.threads,
        overrides=options.overrides,
    )


def _warm_up(player: Player, options: Options) -> None:
    for _ in range(round(options.warm_up / player.step_dt)):
        player.step()


def _frames(player: Player, options: Options) -> Iterator[Frame]:
    """Frames at the film's rate."""
    _warm_up(player, options)
    shot = 0
    for step in range(round(options.seconds / player.step_dt)):
        player.step()
        if (step + 1) * player.step_dt * options.fps > shot + 1e-6:
            shot += 1
            yield player.frame()
