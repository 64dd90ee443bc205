"""One `polypod play` from its options to its last line."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from polypod import _core, bundled, interrupts
from polypod.play.live import OWN, TOGETHER, Choice, Live, columns_of
from polypod.play.panel import Panel
from polypod.play.player import Player
from polypod.play.viewer import HOST, Viewer
from polypod.render.film import Film
from polypod.render.raster import picture

MOST_CHECKPOINTS = 20
"""Number of the training's checkpoints that the page offers in addition to the first one."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line of `polypod play`."""

    checkpoint: Path
    robots: Sequence[str] | None = None
    command: Sequence[float] | None = None
    task: str | None = None
    envs_per_robot: int = 1
    seconds: float | None = None
    """Simulated time, s; None: without end in the browser, else 10."""
    warm_up: float = 0.0
    """Simulated before anything is shown or recorded, s."""
    record: Path | None = None
    video: Path | None = None
    fps: int = 25
    size: tuple[int, int] = (640, 360)
    headless: bool = False
    host: str = HOST
    port: int = 8080
    meshes: bool = False
    """Show the makers' meshes."""
    seed: int = 0
    threads: int | None = None
    overrides: Sequence[str] = ()
    terms: Path | None = None


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
    length = 10.0 if options.seconds is None else options.seconds
    film = Film(options.video, options.fps, options.size, length) if options.video is not None else None
    live = not options.headless and film is None and options.record is None
    player = _player(options, live)
    viewer = None
    if live or options.record is not None:
        viewer = Viewer(player, options.port, options.host, meshes=options.meshes, columns=columns_of(player))
        for warning in viewer.warnings:
            print(warning, flush=True)
    for _ in range(round(options.warm_up / player.step_dt)):
        player.step()
    seconds = options.seconds if live else length
    try:
        if live and viewer is not None:
            print(_address(viewer, player.sim.task_name), flush=True)
            player = _watch(player, viewer, options, seconds)
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


def _player(options: Options, live: bool) -> Player:
    """The player that is shown first.

    On flat ground in the browser robots begin side by side, as with a command: they are to follow
    the same one.
    """

    def build(command: Sequence[float] | None) -> Player:
        return Player(
            options.checkpoint,
            options.robots,
            command,
            task=options.task,
            envs_per_robot=options.envs_per_robot,
            seed=options.seed,
            threads=options.threads,
            overrides=options.overrides,
            terms=options.terms,
        )

    player = build(options.command)
    if live and options.command is None and player.alone and player.sim.num_envs > 1:
        return build((0.0, 0.0, 0.0))
    return player


def _watch(player: Player, viewer: Viewer, options: Options, seconds: float | None) -> Player:
    """Steps in real time and shows every control step; returns what was shown last."""
    policies = _policies(options.checkpoint)
    given = next(name for name, file in policies.items() if file == options.checkpoint)
    robot = options.robots[0] if options.robots is not None and len(options.robots) == 1 else None
    first = Choice(given, options.task, robot)

    tasks = [entry["name"] for entry in _core.tasks() if "-Play-" in entry["name"] and entry["num_robots"] != 1]

    def build(choice: Choice) -> Player:
        robots_of_page = [*live.player.policy_robots, *(entry["name"] for entry in _core.robots())]
        _check_offered(choice, first, list(policies), tasks, robots_of_page)
        robots: Sequence[str] | None = None if choice.robot is None else [choice.robot]
        if choice == first or (choice.policy == given and robots is None):
            robots = options.robots
        changed = dataclasses.replace(
            options,
            checkpoint=policies[choice.policy],
            task=choice.task,
            robots=robots,
            command=None,
            overrides=options.overrides if choice.task == options.task else (),
            terms=options.terms if choice.policy == given else None,
        )
        return _player(changed, live=True)

    live = Live(player, viewer, build, first, seed=options.seed)
    panel = Panel(live, list(policies), tasks)
    if options.command is not None:
        live.own[:] = options.command
        live.command_by(OWN)
    elif player.alone and player.sim.num_envs > 1 and player.has_velocity:
        live.command_by(TOGETHER)
    panel.refresh()
    try:
        live.run(seconds)
    except KeyboardInterrupt:
        interrupts.watch()  # this one has done what it was for
    return live.player


def _address(viewer: Viewer, task: str) -> str:
    """Address of the page, and a warning where others can see it."""
    if viewer.public_url is None:
        return f"{task}: open {viewer.url} in a browser; Ctrl-C ends"
    here = f" (on this machine {viewer.url})" if viewer.url != viewer.public_url else ""
    return (
        f"{task}: open {viewer.public_url}{here} in a browser; Ctrl-C ends\n"
        "polypod: warning: everyone who reaches this address can steer, and choose among the policies, tasks and "
        "robots of the page; leave --host out to serve this machine alone"
    )


def _check_offered(
    choice: Choice, first: Choice, policies: Sequence[str], tasks: Sequence[str], robots: Sequence[str]
) -> None:
    """Raises ConfigError for names that the page does not list: it opens no files by path."""
    offered = {
        "policy": choice.policy in policies,
        "task": choice.task in (None, first.task, *tasks),
        "robots": choice.robot in (None, first.robot, *robots),
    }
    for name, is_offered in offered.items():
        if not is_offered:
            raise _core.ConfigError(f"{name}: choose from the list of the page")


def _policies(checkpoint: Path) -> dict[str, Path]:
    """Policies that the page offers: the given one, its training's others, and bundled ones."""
    known = {bundled.checkpoint(name): f"bundled: {name}" for name in bundled.FOLDERS}
    files = {known.get(checkpoint, checkpoint.name): checkpoint}
    others = sorted(checkpoint.parent.glob("model_*.pt"), key=lambda file: (len(file.name), file.name))
    stride = -(-len(others) // MOST_CHECKPOINTS)
    for file in others[:: max(1, stride)]:
        if file != checkpoint and file not in known:
            files.setdefault(file.name, file)
    return files | {name: file for file, name in known.items()}


def _record(player: Player, viewer: Viewer | None, film: Film | None, seconds: float) -> None:
    """Steps as fast as possible.

    A recording holds all control steps, a film as many frames as its rate asks for.
    """
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
