"""`polypod motions`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from polypod import _core
from polypod.commands.arguments import Count, Name, Overrides, Robots, arg, names, positive, thread_count, write_json

Action = Literal["list", "show", "draw", "import", "retarget", "eval"]


@dataclasses.dataclass(frozen=True)
class Motions:
    """Draw, import and retarget reference motions, and measure policies that track them.

    They are motions of humanoids, see docs/motions.md.

    Exit code 3 where eval finds a motion that is not followed in 95 % of the episodes.
    """

    action: Annotated[Action, tyro.conf.Positional]
    """list: drawn motions. show: what a motion is like on a robot, in words. draw: make a drawn
    motion for a robot, as .npz. import: read a .csv of frames. retarget: make a motion for another
    robot, and say what is lost. eval: measure a policy."""
    motion: Annotated[str | None, tyro.conf.Positional, arg(metavar="MOTION")] = None
    """Name of a drawn motion or an .npz; the .csv of import; the checkpoint of eval."""
    robot: Name = None
    """Name or config of the robot. Default: unitree_g1, or the one that the file names."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The .npz that draw, import and retarget write."""
    fps: float = 30.0
    """Frames per second of the .csv that import reads."""
    joints: Annotated[str | None, arg(metavar="A,B,C")] = None
    """Joints in the order of the columns of the .csv, where its first line does not name them;
    `robot` for the order of the robot's URDF."""
    ground: bool = False
    """Move the imported motion up or down so that its feet stand on the ground."""
    robots: Robots = None
    """Robots that eval measures. Default: those of the run."""
    clips: Annotated[str | None, arg(metavar="A,B,C")] = None
    """Motions that eval measures. Default: those of the run."""
    episodes: int = 16
    """Episodes of each robot and motion in eval."""
    seed: int = 0
    """Seed of the noise with which episodes of eval begin."""
    mujoco: bool = False
    """Measure in MuJoCo in the place of polypod, from the same states; needs the extra bench."""
    threads: Count = None
    """Threads of the simulator in eval. Default: one per core."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to which eval also writes the figures."""
    set: Overrides = ()
    """Changes the task's configuration in eval. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        for key, actions in _BELONGS.items():
            if self.action not in actions and getattr(self, key) != usual[key]:
                raise _core.ConfigError(f"--{key} belongs to polypod motions {actions[0]}; leave it out")
        if self.action == "list":
            return self._list()
        if self.motion is None:
            raise _core.ConfigError(f"polypod motions {self.action} needs a motion or a file after it")
        if self.action == "eval":
            return self._eval(self.motion)
        return self._make(self.motion)

    def _list(self) -> int:
        from polypod.motions import key_poses

        for name in key_poses.names():
            print(f"{name:<10} {key_poses.duration(name):4.1f} s  {key_poses.title(name)}")
        return 0

    def _make(self, name: str) -> int:
        from polypod.motions import library, motion
        from polypod.motions.body import body_of
        from polypod.motions.retarget import on_the_ground

        if self.action != "show" and self.out is None:
            raise _core.ConfigError("--out is missing: name the .npz to write")
        if self.action == "retarget" and self.robot is None:
            raise _core.ConfigError("--robot is missing: name the robot that the motion is for")
        robot = self.robot or "unitree_g1"
        if self.action == "import":
            body = body_of(robot)
            columns = list(body.joints) if self.joints == "robot" else names(self.joints)
            made = motion.read_csv(Path(name), body.source, self.fps, columns)
            body.qpos(made)
            if self.ground:
                made, shift = on_the_ground(made, body)
                print(f"moved by {shift:+.3f} m, so that the feet stand on the ground")
        else:
            if self.robot is None and name.endswith(".npz"):
                robot = motion.read(Path(name)).robot or robot
            made = library.clip_of(name, robot)
        for text in _figures(made):
            print(text)
        if self.out is not None:
            motion.save(made, self.out)
            print(self.out)
        return 0

    def _eval(self, checkpoint: str) -> int:
        from polypod import runs
        from polypod.evaluation import tracking
        from polypod.sim2sim import on_motions

        measure = on_motions.measure_checkpoint if self.mujoco else tracking.measure_checkpoint
        found = measure(
            Path(runs.resolve(Path(checkpoint), Path("logs"))),
            names(self.robots),
            names(self.clips),
            episodes=positive(self.episodes, "--episodes") or 1,
            seed=self.seed,
            threads=thread_count(self.threads, "--threads"),
            overrides=list(self.set),
        )
        for text in tracking.lines_of(found):
            print(text)
        write_json(self.json, tracking.as_dict(found))
        return 0 if tracking.follows(found) else 3


def _figures(made: Any) -> list[str]:
    """A motion in words."""
    import numpy as np

    from polypod.motions.body import body_of
    from polypod.motions.motion import velocities

    body = body_of(made.robot)
    linear, _, joints = velocities(made)
    gap = body.feet_gap(body.qpos(made))
    away = made.base_pos[-1, :2] - made.base_pos[0, :2]
    fastest = int(np.abs(joints).max(axis=0).argmax())
    return [
        f"{made.name} of {body.name}: {made.frames} frames at {made.fps:g} Hz, {made.duration_s:.1f} s",
        f"base: height {made.base_pos[:, 2].min():.3f} to {made.base_pos[:, 2].max():.3f} m, ends {away[0]:+.2f} m "
        f"forward and {away[1]:+.2f} m left, at most {np.linalg.norm(linear, axis=1).max():.2f} m/s",
        f"feet: {1000.0 * gap.min():.0f} to {1000.0 * gap.max():.0f} mm above the ground; in the air for "
        f"{(gap.min(axis=1) > 0.01).mean():.0%} of the time",
        f"joints: at most {np.abs(joints).max():.1f} rad/s ({made.joint_names[fastest]})",
        *(f"lost: {note}" for note in made.notes),
    ]


_BELONGS: dict[str, tuple[str, ...]] = {
    "out": ("draw", "import", "retarget"),
    "fps": ("import",),
    "joints": ("import",),
    "ground": ("import",),
    "robot": ("show", "draw", "import", "retarget"),
    "robots": ("eval",),
    "clips": ("eval",),
    "episodes": ("eval",),
    "seed": ("eval",),
    "mujoco": ("eval",),
    "threads": ("eval",),
    "json": ("eval",),
    "set": ("eval",),
}
