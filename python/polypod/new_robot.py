"""A config for a robot of which only the URDF is known: drafted, written, and tried out."""

import contextlib
import dataclasses
import functools
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping
from copy import deepcopy
from pathlib import Path
from typing import ParamSpec, TypeAlias
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from polypod import _core, bare_ends, base_frames, massless_links, token_inertias, urdf_copies
from polypod.compat import tomllib
from polypod.files import real_path, relative_path, write_text
from polypod.vector_env import make

Draft: TypeAlias = "_core.RobotDraft"
Given = ParamSpec("Given")

DRAFTED = "# Drafted by `polypod robot new`"
"""Begin of a config that was drafted."""

TASK = "velocity_flat_play"
TASK_OF_OTHERS = "velocity_flat_legged_play"
"""Task of bodies other than quadrupeds of twelve joints: it has their reward sets."""
SECONDS = 4.0
NUM_ENVS = 16
SAG = 0.3
"""Largest mean distance of a standing robot's joint from the default pose, rad. Makers' gains allow
as much: ANYmal D gives way by 0.28 rad and Go2 by 0.26."""
ON_TWO_LEGS = ("biped", "humanoid")
"""Kinds whose gains a policy needs to balance; see src/draft/balance.rs."""
STIFFER = 1.5
"""Factor on the gains for the next try."""
TRIES = 4
CARRIED = 0.95
"""Least share of the weight that the feet of a standing robot carry: the rest lies on its belly or
its knees."""
AT_ONCE = 0.05
"""A robot that falls within this time has not fallen: its episode ended for another reason, s."""
MANY_HELD = 4
"""Number of joints, held for the same reason, from which one line says it for all."""
_HELD = re.compile(r"\[locked_joints\]: .* is (a finger|a rod or a gear|no leg's|coupled).* held at .*")
_LIMIT = re.compile(r"\[actuators\]: the URDF(?:'s| has no) (effort|velocity) limit ")
SETTLED = 1.0
"""At the end of standing, in which the weight is measured, s."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """Result of letting a robot hold its default pose."""

    falls: int
    """Number of the `NUM_ENVS` robots that fell."""
    sag: float
    """Mean distance of the joint that gives way most from the default pose, rad."""
    height: float
    """Height of the base's frame above the ground, mean, m."""
    lasted: float
    """Time until the first of them fell, or all of it, s."""
    carried: float
    """Share of the weight that the feet carry, the least of all robots; in the last second, or
    until one fell."""

    @property
    def holds(self) -> bool:
        """Whether nobody fell, no joint gave way and the feet carry the robot."""
        return self.falls == 0 and self.sag <= SAG and self.carried >= CARRIED


@dataclasses.dataclass(frozen=True)
class NewRobot:
    """Config that was written."""

    name: str
    path: Path
    """Path of the TOML."""
    notes: list[str]
    """Assumptions, one line each."""
    standing: Standing
    """Result on the gains of the config."""
    pose_holds: bool
    """Whether it stands in its pose; two legs are tried on stiff gains, which the config does not
    have."""
    gain_factor: float
    """Factor on the gains that follow from weight and leg length."""
    kind: str
    """`biped`, `humanoid`, `quadruped`, `hexapod` ..."""
    is_quadruped: bool
    """Whether it has twelve joints in four legs, which the tasks of quadrupeds know."""
    needs_policy: str | None
    """Why it does not stand by itself, where it does not for a reason that gains do not change."""


def _blaming_the_urdf(function: Callable[Given, NewRobot]) -> Callable[Given, NewRobot]:
    """Lets a function say what is wrong with its URDF where the config that it drafts is refused.

    Nobody wrote that config, and it does not stay.
    """

    @functools.wraps(function)
    def blaming(*args: Given.args, **kwargs: Given.kwargs) -> NewRobot:
        try:
            return function(*args, **kwargs)
        except _core.ConfigError as error:
            file, _, problem = str(error).partition(".toml: ")
            config, urdf = Path(f"{file}.toml"), args[0] if args else kwargs["urdf"]
            if not problem or not isinstance(urdf, Path) or not _is_draft(config):
                raise
            config.unlink()
            raise _core.RobotError(_refusal(urdf, problem)) from error

    return blaming


def _is_draft(config: Path) -> bool:
    try:
        return config.read_text(encoding="utf-8").startswith(DRAFTED)
    except (OSError, ValueError):
        return False


def _refusal(urdf: Path, problem: str) -> str:
    """The fault of a URDF whose draft has this problem."""
    with contextlib.suppress(_core.PolypodError):
        for note in _core.draft_robot(urdf, urdf=urdf.name)["notes"]:
            if "it looks like" in note:
                return f"{urdf}: {note}"
    what, _, _ = problem.rpartition("; ")
    return (
        f"{urdf}: a config that follows from it is refused: {what}; a URDF has metres, kilograms and radians: look at "
        "its lengths, masses and limits"
    )


@_blaming_the_urdf
def new_robot(
    urdf: Path,
    out: Path | None = None,
    name: str | None = None,
    package_dirs: Mapping[str, str | os.PathLike[str]] | None = None,
    feet: Mapping[str, str] | None = None,
    force: bool = False,
    *,
    joint_roles: Mapping[str, str] | None = None,
    locked_joints: Mapping[str, float] | None = None,
    urdf_key: str | None = None,
    refine: Callable[[str], str] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> NewRobot:
    """Drafts a config for the robot of a URDF file and lets it stand; stiffer where it gives way.

    Args:
        urdf: the URDF file.
        out: the TOML to write; None: `<name>.toml` next to the URDF. Its stem is the robot's name.
        name: the robot's name; None: that of `out`, of the URDF, or of its file.
        package_dirs: ROS package -> folder, for `package://` names of meshes.
        feet: leg (`LF`, `LH`, `RF`, `RH`; `L`, `R` of a biped) -> the link that is its foot, where
            geometry alone does not tell.
        force: write over a file that is there.
        joint_roles: slot -> joint of the URDF, where geometry alone does not tell.
        locked_joints: joint of the URDF -> position at which it is held, rad or m.
        urdf_key: what the config says under `urdf`; None: the file, relative to the config.
        refine: makes the text that is written of a draft's.
        progress: told a part of the work, how much of it is done, and all of it.

    Raises:
        RobotError: where the URDF cannot be read, is no legged robot's or has millimetres.
        ConfigError: where the file is there already, cannot be written, or has another name than
            the robot.
    """
    if name is None and out is not None:
        name = out.stem
    folder = (urdf if out is None else out).parent
    drafts_of = functools.partial(
        _core.draft_robot,
        name=name,
        package_dirs={package: real_path(place) for package, place in (package_dirs or {}).items()},
        feet=feet or {},
        joint_roles=joint_roles or {},
        locked_joints=locked_joints or {},
    )
    copy, packages, stem = None, package_dirs or {}, _stem_of_copies(urdf, out, folder)
    if (tree := urdf_copies.read(urdf)) is not None:
        try:
            base_frames.check_units(urdf, tree)
            # a library's own copy of a URDF stays what the file says
            if not urdf_key:
                copy = _copy(
                    urdf, tree, folder, stem, drafts_of, locked_joints or {}, packages, keeps_up=bool(joint_roles)
                )
        except _core.PolypodError:
            raise
        except ValueError:
            # the reader of URDFs says which number is none
            copy = None
    drafted: Callable[..., Draft]
    if copy is None:
        drafted = functools.partial(drafts_of, urdf, urdf=urdf_key or relative_path(real_path(urdf), folder))
    else:
        drafted = _drafts_on(copy, folder / copy.name, drafts_of, out, force)
    if tree is not None and not urdf_key and not joint_roles:
        turned = _turned(urdf, tree, copy, folder, stem, drafted(), packages)
        if turned is not None:
            if copy is not None:
                (folder / copy.name).unlink()
            copy, drafted = turned, _drafts_on(turned, folder / turned.name, drafts_of, out, force)

    def written(draft: Draft) -> str:
        return draft["toml"] if refine is None else refine(draft["toml"])

    text, tell = "", progress or (lambda part, done, total: None)
    for attempt in range(TRIES):
        factor = STIFFER**attempt
        tell(f"try {attempt + 1}: drafts", 0, 1)
        draft = drafted(gain_factor=factor)
        tell(f"try {attempt + 1}: drafts", 1, 1)
        path = urdf.with_name(f"{draft['name']}.toml") if out is None else out
        if attempt == 0:
            _check_place(path, draft["name"], force)
        try:
            before, text = text, written(draft)
            if text == before:
                # the gains are not the draft's
                factor = 1.0
                break
            write_text(path, text)
        except OSError as error:
            raise _core.ConfigError(f"cannot write {path}: {error.strerror}; choose another --out") from error
        standing = stand(path, functools.partial(tell, f"try {attempt + 1}: stands"))
        if standing.holds or draft["needs_policy"]:
            break
    needs, pose_holds = draft["needs_policy"], standing.holds
    if needs is None and not standing.holds and standing.lasted <= AT_ONCE:
        needs = "its episodes end as they begin: look at the height of its base and at the task's terminations"
    if draft["kind"] in ON_TWO_LEGS:
        # stiff gains tell whether the pose is sound, and no more
        factor = 1.0
        draft = drafted(balanced=True)
        write_text(path, text := written(draft))
        standing = stand(path, functools.partial(tell, "last try: stands"))
        if needs is None and not standing.holds:
            stiff = "" if pose_holds else ", on stiff gains too"
            needs = f"its ankles hold less than the moment of its weight as it leans{stiff}: a policy balances it"
    if standing.holds:
        needs = None
    elif needs is not None and factor > 1.0:
        # softer gains move the better: stiffer ones did not help
        factor = 1.0
        draft = drafted()
        write_text(path, text := written(draft))
    notes = [note for note in draft["notes"] if not base_frames.is_taken(note)]
    notes = [*(copy.notes if copy is not None else []), *_held_as_one(_still_assumed(notes, text))]
    name, kind, is_quadruped = draft["name"], draft["kind"], task_of(path) == TASK
    return NewRobot(name, path, notes, standing, pose_holds, factor, kind, is_quadruped, needs)


def _still_assumed(notes: Collection[str], text: str) -> list[str]:
    """Notes without those on motors' limits that a refined config has from another file."""
    assumed = {line.split("_limit ")[0] for line in text.splitlines() if ", assumed: " in line}
    found = [_LIMIT.match(note) for note in notes]
    return [note for note, limit in zip(notes, found, strict=True) if limit is None or limit[1] in assumed]


def _held_as_one(notes: Collection[str]) -> list[str]:
    """Notes with one line for joints that are held for the same reason: hands have twenty."""
    groups: dict[str, list[str]] = {}
    for note in notes:
        found = _HELD.fullmatch(note)
        groups.setdefault(note if found is None else found.group(1), []).append(note)
    return [
        line
        for group in groups.values()
        for line in (group if len(group) < MANY_HELD else [f"{group[0]} (as are {len(group) - 1} more)"])
    ]


def robot_name(given: Path) -> str:
    """A name for the robot and its run, of letters that every file system takes."""
    name = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in given.stem.lower())
    return name[:60] or "robot"


def _stem_of_copies(urdf: Path, out: Path | None, folder: Path) -> str:
    """The beginning of a copy's name: the file's, or the robot's where another draft took that.

    Many files are called robot.urdf, and drafts of several may lie in one folder.
    """
    if out is None:
        return urdf.stem
    copy = re.compile(rf'^urdf = "{re.escape(urdf.stem)}_\w+\.urdf"', re.MULTILINE)
    for other in folder.glob("*.toml"):
        with contextlib.suppress(OSError, ValueError):
            if other.name != out.name and copy.search(other.read_text(encoding="utf-8")):
                return out.stem
    return urdf.stem


def _copy(
    urdf: Path,
    robot: ElementTree.Element,
    folder: Path,
    stem: str,
    drafts_of: Callable[..., Draft],
    held: Collection[str],
    packages: Collection[str],
    *,
    keeps_up: bool,
) -> urdf_copies.Copy | None:
    """The copy of a URDF for drafts, to lie in this folder; None where none is needed.

    `stem` begins its name.
    """
    massless = massless_links.notes(*massless_links.settle(robot, held))
    tokens = token_inertias.replace(robot)
    impossible = token_inertias.replace_impossible(robot)
    links = bare_ends.add_boxes(robot, held)
    upright, assumed, moved = upright_of(urdf, robot, drafts_of, packages, keeps_up=keeps_up)
    ends = f"a box at the end of each limb: {', '.join(links)}"
    changes = {
        "upright": ("an upright base", [assumed] if assumed else []),
        "centred": ("the base frame in the middle", [moved] if moved else []),
        "with_masses": ("masses of moving links", massless),
        "with_inertias": ("inertias of bars", token_inertias.notes(tokens, impossible)),
        "with_feet": (ends, [bare_ends.note(link) for link in links]),
    }
    made = {ending: change for ending, change in changes.items() if change[1]}
    if not made:
        return None
    what = f"{urdf.name} with {' and '.join(what for what, _ in made.values())}"
    text = urdf_copies.text_of(upright, what, urdf, folder, packages)
    notes = [note for _, own in made.values() for note in own]
    return urdf_copies.Copy(text, f"{'_'.join([stem, *made])}.urdf", notes)


def _turned(
    urdf: Path,
    robot: ElementTree.Element,
    copy: urdf_copies.Copy | None,
    folder: Path,
    stem: str,
    draft: Draft,
    packages: Collection[str],
) -> urdf_copies.Copy | None:
    """The copy of a URDF, or of its copy, whose base looks ahead; None where it does."""
    own = urdf if copy is None else folder / copy.name
    robot = deepcopy(robot) if copy is None else ElementTree.fromstring(copy.text)
    try:
        note = base_frames.turn_round(robot, tomllib.loads(draft["toml"]))
    except ValueError:
        # the reader of URDFs takes these numbers
        return None
    if note is None:
        return None
    text = urdf_copies.text_of(robot, f"{own.name} with its base turned round", own, folder, packages)
    begin = stem if copy is None else own.stem
    return urdf_copies.Copy(text, f"{begin}_turned.urdf", [*(copy.notes if copy else []), note])


def upright_of(
    urdf: Path,
    robot: ElementTree.Element,
    drafts_of: Callable[..., Draft],
    packages: Collection[str] = (),
    *,
    keeps_up: bool,
) -> tuple[ElementTree.Element, str | None, str | None]:
    """A robot with its base's frame upright and in the middle.

    Args:
        urdf: the file that the robot was read from, for the names of its meshes.
        robot: its tree, which stays as it is.
        drafts_of: drafts a config for the file of a URDF; raises where there is none.
        packages: ROS packages whose folders are known.
        keeps_up: whether legs that point away from -z stay: roles that are named tell more than
            where feet are.

    Returns:
        The tree, and what was assumed of the axes and of the middle, None where nothing was.
    """
    upright = deepcopy(robot)
    turned = None if keeps_up else base_frames.turn_upright(upright)
    assumed = turned or base_frames.put_upright(upright)
    moved = base_frames.put_in_the_middle(upright)
    if assumed is not None and not _is_taken(urdf, upright, drafts_of, packages, is_turned=turned is not None):
        upright, assumed = deepcopy(robot), None
        moved = base_frames.put_in_the_middle(upright)
    return upright, assumed, moved


def _is_taken(
    urdf: Path,
    robot: ElementTree.Element,
    drafts_of: Callable[..., Draft],
    packages: Collection[str],
    *,
    is_turned: bool,
) -> bool:
    """Whether the joints of a robot fit its upright root better than the root of the file.

    A base that is turned itself fits if it has a draft.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "trial.urdf"
        trial.write_text(urdf_copies.text_of(deepcopy(robot), urdf.name, urdf, Path(folder), packages), "utf-8")
        try:
            notes = drafts_of(trial, urdf=trial.name)["notes"]
        except (_core.RobotError, _core.ConfigError):
            return False
    return is_turned or any(base_frames.is_taken(note) for note in notes)


def _drafts_on(
    copy: urdf_copies.Copy, file: Path, drafts_of: Callable[..., Draft], out: Path | None, force: bool
) -> Callable[..., Draft]:
    """Writes the copy of a URDF, of which drafts are made; leaves none that has no draft."""
    if file.exists() and not force:
        raise _core.ConfigError(f"{file} is there already; pass --force to write over it, or choose another --out")
    drafted = functools.partial(drafts_of, file, urdf=file.name)
    try:
        write_text(file, copy.text)
        name = drafted()["name"]
        _check_place(file.with_name(f"{name}.toml") if out is None else out, name, force)
    except OSError as error:
        raise _core.ConfigError(f"cannot write {file}: {error.strerror}; choose another --out") from error
    except (_core.RobotError, _core.ConfigError):
        file.unlink()
        raise
    return drafted


def _check_place(path: Path, name: str, force: bool) -> None:
    if path.suffix != ".toml" or path.stem != name:
        raise _core.ConfigError(f"--out {path}: the file of a robot `{name}` is {name}.toml")
    if path.exists() and not force:
        raise _core.ConfigError(f"{path} is there already; pass --force to write over it, or choose another --out")


def stand(robot: Path, progress: Callable[[int, int], None] | None = None) -> Standing:
    """Lets the robot of a config hold its default pose on flat ground for `SECONDS`.

    `progress` is told the control steps so far, and all of them.
    """
    env = make(task_of(robot), NUM_ENVS, robots=[str(robot)], seed=0, autoreset="disabled")
    try:
        env.reset()
        actions = np.zeros((NUM_ENVS, env.sim.num_actions), dtype=np.float32)
        fallen = np.zeros(NUM_ENVS, dtype=np.bool_)
        (info,) = json.loads(env.sim.robot_info()).values()
        carried: list[npt.NDArray[np.float32]] = []
        steps = round(SECONDS / env.step_dt)
        for step in range(steps):
            if progress is not None:
                progress(step + 1, steps)
            fallen |= env.step(actions)[2]
            if fallen.any():
                break
            carried.append(env.state.contact_forces.reshape(NUM_ENVS, -1, 3)[:, :, 2].sum(axis=1))
        up = ~fallen if not fallen.all() else np.ones_like(fallen)
        gap = np.abs(env.state.joint_pos - env.state.default_joint_pos)[up].mean(axis=0)
        height = float(env.state.base_height[up].mean())
        last = carried[-round(SETTLED / env.step_dt) :]
        weight = info["mass"] * float(np.linalg.norm(env.sim.gravity))
        share = float(np.mean(last, axis=0).min()) / weight if last else 0.0
        lasted = (len(carried) + bool(fallen.any())) * env.step_dt
        return Standing(int(fallen.sum()), float(gap.max()), height, lasted, share)
    finally:
        env.close()


def print_standing(new: NewRobot) -> None:
    """Prints how a robot holds its default pose, and warns where it does not."""
    standing = new.standing
    print(
        f"{new.name}: {NUM_ENVS - standing.falls} of {NUM_ENVS} stand for {SECONDS:g} s, the base "
        f"{standing.height:.3f} m high, joints at most {standing.sag:.2f} rad from the default pose"
    )
    if new.gain_factor > 1.0:
        print(f"  gains are {new.gain_factor:.2f} times what weight and leg length ask for: softer ones gave way")
    if standing.carried < CARRIED and new.needs_policy is None:
        print(f"  the feet carry {standing.carried:.0%} of the weight: it lies on its belly or its knees")
    if new.needs_policy is not None:
        print(f"  {new.needs_policy}")
    elif not standing.holds:
        print(
            f"polypod: warning: {new.name} does not hold its default pose; look at [default_pose] and [actuators] "
            f"in {new.path}",
            file=sys.stderr,
        )


def training_of(new: NewRobot, robot: str) -> str:
    """The command that trains the robot under this name or path."""
    others = "" if new.is_quadruped else "--train-config specialist "
    return f"polypod train {others}--robots {robot}"


def task_of(robot: Path) -> str:
    """The task on flat ground, in its Play variant, that has the reward sets of a robot's class."""
    joints = tomllib.loads(robot.read_text(encoding="utf-8"))["default_pose"]
    is_quadruped = len(joints) == 12 and all(joint.endswith(("_HAA", "_HFE", "_KFE")) for joint in joints)
    return TASK if is_quadruped else TASK_OF_OTHERS
