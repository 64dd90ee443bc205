"""Draws of bodies of every kind, and libraries of them."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polypod import _core
from polypod.bodies import bipeds, files, hexapods, quadrupeds, two_legs
from polypod.bodies.parts import Body
from polypod.files import new_folder, write_text

BY_DEFAULT = ("quadruped", "quadruped8", "biped", "humanoid", "hexapod")
"""Four legs of three joints or of two, two legs, two legs with arms, six legs."""
KINDS = (*BY_DEFAULT, "quadruped_arm")
"""All kinds: also four legs of three joints with an arm on the base."""
TASK = "velocity_flat_generated"


def draw(kind: str, name: str, rng: np.random.Generator, wide: bool = False) -> Body:
    """Draws a body of one of `KINDS`. The same generator state gives the same body.

    With `wide`, quadrupeds also differ in what makers choose in different ways: where the thigh
    hangs on the hip, joint limits, weak and strong motors, slow and fast ones, dry friction, and
    soft and stiff gains. Bodies on two legs are those of `polypod.bodies.two_legs`.
    """
    on_two_legs = two_legs.draw if wide else bipeds.draw
    makers = {
        "quadruped": lambda: quadrupeds.draw(name, rng, abduction=True, wide=wide),
        "quadruped8": lambda: quadrupeds.draw(name, rng, abduction=False, wide=wide),
        "biped": lambda: on_two_legs(name, rng, arms=False),
        "humanoid": lambda: on_two_legs(name, rng, arms=True),
        "hexapod": lambda: hexapods.draw(name, rng),
        "quadruped_arm": lambda: quadrupeds.with_arm(quadrupeds.draw(name, rng, abduction=True, wide=wide), rng),
    }
    if kind not in makers:
        raise _core.ConfigError(f"there is no kind of body `{kind}`; known: {', '.join(KINDS)}")
    return makers[kind]()


def generate(
    out: Path,
    count: int,
    seed: int = 0,
    kinds: Sequence[str] = BY_DEFAULT,
    prefix: str = "body",
    force: bool = False,
    *,
    wide: bool = False,
) -> list[Body]:
    """Writes a library of bodies for `POLYPOD_PATH`: a folder with tasks of all of them.

    The i-th body depends on `seed`, `kinds` and i alone, so that more bodies change none.

    Args:
        out: the folder.
        count: how many bodies; kinds take turns.
        seed: of the draws.
        kinds: of `KINDS`.
        prefix: what names begin with; kind and number follow.
        force: write over files that are there.
        wide: see `draw`.

    Raises:
        ConfigError: for an unknown kind or a bad prefix, or where the folder holds files already or
            cannot be written.
    """
    if seed < 0:
        raise _core.ConfigError(f"the seed {seed} is negative; pass 0 or more")
    if not kinds or count < 1:
        raise _core.ConfigError("no bodies are asked for: pass a count of at least 1 and at least one kind")
    if not prefix.isidentifier() or not prefix.isascii() or prefix != prefix.lower():
        raise _core.ConfigError(f"`{prefix}` is no prefix of names: use small letters, digits and underscores")
    if out.exists() and not out.is_dir():
        raise _core.ConfigError(f"{out} is no folder; choose another one")
    if out.is_dir() and any(out.iterdir()) and not force:
        raise _core.ConfigError(f"{out} holds files already; pass --force to write over them, or choose another folder")
    digits = len(str(count - 1))
    bodies = []
    for index in range(count):
        kind = kinds[index % len(kinds)]
        bodies.append(draw(kind, f"{prefix}_{kind}_{index:0{digits}}", np.random.default_rng([seed, index]), wide))
    try:
        with new_folder(out) as folder:
            _write(folder, bodies, seed)
            facts = {"count": count, "seed": seed, "kinds": list(kinds), "prefix": prefix, "wide": wide}
            write_text(folder / "bodies.json", json.dumps(facts) + "\n")
    except OSError as error:
        raise _core.ConfigError(f"cannot write {out}: {error.strerror}; choose another folder") from error
    return bodies


def _write(out: Path, bodies: Sequence[Body], seed: int) -> None:
    """Writes the URDFs, the configs and the tasks of bodies."""
    for body in bodies:
        write_text(out / "assets" / "robots" / body.name / "robot.urdf", files.urdf(body))
        write_text(out / "configs" / "robots" / f"{body.name}.toml", files.toml(body, seed))
    for name, text in files.tasks(TASK, [body.name for body in bodies]).items():
        write_text(out / "configs" / "tasks" / f"{name}.toml", text)
