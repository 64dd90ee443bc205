"""One `polypod play` from its options to its last line."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from polypod import _core
from polypod.play.film import Film
from polypod.play.player import Player
from polypod.play.raster import picture
from polypod.play.viewer import Viewer


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line of `polypod play`."""

    checkpoint: Path
    robots: Sequence[str] | None = None
    command: Sequence[float] | None = None
    task: str | None = None
    envs_per_robot: int = 1
    seconds: float | None = None
    """Of simulated time; None: without end in the browser, else 10."""
    warm_up: float = 0.0
    """Simulated before anything is shown or recorded, s."""
    record: Path | None = None
    video: Path | None = None
    fps: int = 25
    size: tuple[int, int] = (640, 360)
    headless: bool = False
    port: int = 8080
    seed: int = 0
    threads: int | None = None
    overrides: Sequence[str] = ()


def play(options: Options) -> Player:
    """Plays the policy; returns the player, whose tallies say how the robots did.

    Raises:
        ConfigError: for options that cannot be used, and where a package is missing.
    """
    if options.envs_per_robot < 1:
        raise _core.ConfigError(f"--num-envs {options.envs_per_robot} must be at least 1")
    if not 0 <= options.port <= 65535:
        raise _core.ConfigError(f"--port {options.port} must be from 0 to 65535; 0 takes a free one")
    if options.record is not None and options.record.suffix not in (".html", ".viser"):
        raise _core.ConfigError(f"--record {options.record}: the name must end in .html or .viser")
    for flag, seconds in (("--seconds", options.seconds), ("--warm-up", options.warm_up)):
        if seconds is not None and not 0.0 <= seconds < 1e6:
            raise _core.ConfigError(f"{flag} {seconds} is not a number of seconds")
    film = Film(options.video, options.fps, options.size) if options.video is not None else None
    player = Player(
        options.checkpoint,
        options.robots,
        options.command,
        task=options.task,
        envs_per_robot=options.envs_per_robot,
        seed=options.seed,
        threads=options.threads,
        overrides=options.overrides,
    )
    live = not options.headless and film is None and options.record is None
    viewer = Viewer(player, options.port) if live or options.record is not None else None
    for _ in range(round(options.warm_up / player.step_dt)):
        player.step()
    seconds = options.seconds if options.seconds is not None or live else 10.0
    try:
        if live and viewer is not None:
            print(f"{player.sim.task_name}: open {viewer.url} in a browser; Ctrl-C ends", flush=True)
            _watch(player, viewer, seconds)
        else:
            _record(player, viewer, film, seconds or 0.0)
        if viewer is not None and options.record is not None:
            viewer.write(options.record)
        if film is not None:
            film.close()
    finally:
        if viewer is not None:
            viewer.close()
    return player


def _watch(player: Player, viewer: Viewer, seconds: float | None) -> None:
    """Steps in real time and shows every control step."""
    pause, _ = viewer.controls()
    end = None if seconds is None else player.time + seconds
    due = time.monotonic()
    try:
        while end is None or player.time < end - 0.5 * player.step_dt:
            if not pause.value:
                player.step()
                viewer.show(player.frame())
            due = max(due + player.step_dt, time.monotonic() - 0.5)
            time.sleep(max(0.0, due - time.monotonic()))
    except KeyboardInterrupt:
        return


def _record(player: Player, viewer: Viewer | None, film: Film | None, seconds: float) -> None:
    """Steps as fast as possible; a recording holds all control steps, a film its own rate."""
    if viewer is not None:
        viewer.record()
    began = player.time
    shot = 0
    for _ in range(round(seconds / player.step_dt)):
        player.step()
        due = film is not None and (player.time - began) * film.fps > shot + 1e-6
        if viewer is None and not due:
            continue
        frame = player.frame()
        if viewer is not None:
            viewer.show(frame)
            viewer.tick(player.step_dt)
        if film is not None and due:
            film.add(picture(player, frame, film.size))
            shot += 1
