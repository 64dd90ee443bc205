"""Contacts of geoms of a compiled MJCF file with its ground, as MuJoCo mixes the two."""

import functools
from typing import Any

import numpy as np

from polypod.add.compiling import Compiled, mujoco
from polypod.add.description import Shape, Surface

PLAIN = (3, (1.0, 0.005, 0.0001), 0.0, 0.0, 0)
"""`condim`, friction, margin, gap and priority of MuJoCo's default geom."""
CONE_DIMS = {1: 0, 3: 1, 4: 2, 6: 3}
"""Number of frictions of a contact, of sliding, torsional and rolling, by `condim`."""


def floor_of(made: Compiled) -> tuple[int, int]:
    """`contype` and `conaffinity` of the file's ground.

    Without ground, those of a plane that touches everything.
    """
    model, ground = made.model, _ground(made)
    return (1, 1) if ground is None else (int(model.geom_contype[ground]), int(model.geom_conaffinity[ground]))


def _ground(made: Compiled) -> int | None:
    """The geom that is the file's ground, if it has one."""
    model = made.model
    kinds = (int(mujoco().mjtGeom.mjGEOM_PLANE), int(mujoco().mjtGeom.mjGEOM_HFIELD))
    for geom in range(model.ngeom):
        is_ground = int(model.geom_type[geom]) in kinds and int(model.geom_bodyid[geom]) not in made.inside
        if is_ground and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            return geom
    return None


def touches(made: Compiled, geom: int, floor: tuple[int, int]) -> bool:
    """Whether a geom can touch a ground with these `contype` and `conaffinity`."""
    model = made.model
    if (int(model.geom_contype[geom]) & floor[1]) or (floor[0] & int(model.geom_conaffinity[geom])):
        return True
    return _pair(made, geom) is not None


def _pair(made: Compiled, geom: int) -> int | None:
    """The `<pair>` of a geom and something of the scene, if there is one."""
    model = made.model
    for pair, (one, other) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True)):
        if geom in (one, other):
            partner = int(other if geom == one else one)
            if int(model.geom_bodyid[partner]) not in made.inside:
                return pair
    return None


def surface_of(made: Compiled, geom: int) -> Surface:
    """Contact of a geom with the ground, as MuJoCo mixes the two."""
    model, pair = made.model, _pair(made, geom)
    if pair is not None:
        of_pair = ("dim", "friction", "margin", "gap")
        return mixed(tuple(_plain(getattr(model, f"pair_{number}")[pair]) for number in of_pair), None)
    numbers = ("condim", "friction", "margin", "gap", "priority")
    sides = [
        tuple(_plain(getattr(model, f"geom_{number}")[each]) for number in numbers)
        for each in (geom, _ground(made))
        if each is not None
    ]
    return mixed(sides[0], sides[1] if len(sides) > 1 else PLAIN)


def _plain(value: Any) -> Any:
    """A number or a list of a model as plain Python values, to be looked up by."""
    return tuple(float(each) for each in value) if np.ndim(value) else value.item()


@functools.cache
def mixed(geom: tuple[Any, ...], ground: tuple[Any, ...] | None) -> Surface:
    """Surface of a geom on the ground, as MuJoCo mixes the numbers of the two.

    It does so in a scene with a ball that has the geom's numbers.

    Args:
        geom: `condim`, friction, margin, gap and priority of one side; of a `<pair>` all but the
            priority.
        ground: of the other side; None for a pair.
    """
    mj = mujoco()
    spec = mj.MjSpec()
    plane = spec.worldbody.add_geom(name="plane", type=mj.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 1.0])
    # in the ground, whatever the margins
    body = spec.worldbody.add_body(pos=[0.0, 0.0, 0.0])
    body.add_freejoint()
    ball = body.add_geom(name="ball", type=mj.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], mass=1.0)
    if ground is None:
        dim, friction, margin, gap = geom
        spec.add_pair(geomname1="plane", geomname2="ball", condim=dim, friction=friction, margin=margin, gap=gap)
    else:
        for each, (dim, friction, margin, gap, priority) in ((ball, geom), (plane, ground)):
            each.condim, each.friction, each.margin, each.gap, each.priority = dim, friction, margin, gap, priority
    model = spec.compile()
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    contact = data.contact[0]
    count = CONE_DIMS[int(contact.dim)]
    sliding, _, torsional, rolling, _ = (float(number) for number in contact.friction)
    return Surface(
        friction=sliding if count > 0 else 0.0,
        torsional_friction=torsional if count > 1 else 0.0,
        rolling_friction=rolling if count > 2 else 0.0,
        contact_margin=max(float(contact.includemargin), 0.0),
    )


def by_surface(shapes: list[Shape]) -> list[tuple[Shape, ...]]:
    """Shapes by what their surfaces are, most shapes first; one empty list without any."""
    groups: dict[Surface, list[Shape]] = {}
    for shape in shapes:
        groups.setdefault(shape.surface, []).append(shape)
    return [tuple(group) for group in sorted(groups.values(), key=len, reverse=True)] or [()]
