"""Kinematics of a humanoid by the roles of its joints."""

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polypod import _core, descriptions, rotations, simulated
from polypod.arrays import Array
from polypod.motions.motion import Motion

SIDES = ("L", "R")
LEG = ("HIP_YAW", "HIP_ROLL", "HIP_PITCH", "KNEE", "ANKLE_PITCH", "ANKLE_ROLL")
ARM = ("SHOULDER_PITCH", "SHOULDER_ROLL", "SHOULDER_YAW", "ELBOW", "WRIST_ROLL", "WRIST_PITCH", "WRIST_YAW")
ITERATIONS = 30
"""Steps of the inverse kinematics, at most."""
DAMPING = 1e-6
"""Square of the damping of least squares, in m^2 and rad^2."""
TURN_WEIGHT = 0.2
"""Weight of a foot's orientation against its position, m/rad: about the length of a foot."""
LOOSE_TURN_WEIGHT = 0.02
"""Weight of the orientation for legs of fewer than six joints, whose feet keep their places and
tilt."""
LARGEST_STEP = 0.4
"""Largest change of a joint in one of them, rad."""
TOLERANCE = 1e-5
"""Largest change of a joint at which they end, rad."""
FLAT = 0.25
"""Largest turn of a foot in the default pose at which its sole counts as flat with straight legs,
rad."""
BEARABLE = 0.35
"""Largest share of an ankle's effort limit that holds the weight on one foot at rest. The others
balance."""
GRAVITY = 9.81
"""Acceleration of free fall, m/s^2."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """A humanoid: its joints by role, and its default pose on the ground."""

    name: str
    source: str
    """Name or path of the config."""
    joints: tuple[str, ...]
    """Names of the joints as in the URDF."""
    links: tuple[str, ...]
    slots: tuple[str, ...]
    """Roles in canonical order."""
    joint_of_slot: npt.NDArray[np.int64]
    sign_of_slot: Array
    """Canonical direction of each slot against the maker's."""
    lower: Array
    upper: Array
    """Limits of the joints, [joints], rad."""
    default: Array
    """Default pose, rad, [joints]."""
    height: float
    """Height of the base in the default pose with flat soles on the ground, m."""
    leg: float
    """Height of the hips in the default pose, m: the unit of drawn and retargeted motions."""
    feet: Array
    """Places of the feet in the default pose, the base above the world's origin, m, [2, 3]."""
    soles: Array
    """Orientations of the feet with flat soles, [2, 4]."""
    hands: tuple[str, ...]
    """Last links of the arms."""
    key_links: tuple[str, ...]
    """Base, torso, hips, knees, feet, shoulders, elbows and hands."""
    rest_point: Array
    """Centre of mass of the default pose, the base above the world's origin, m, [2]."""
    lean: float
    """Distance by which motions carry the base ahead of the default pose's place, m: 0 unless an
    ankle bears the default pose on one foot by more than `BEARABLE`."""

    def slot(self, name: str) -> int | None:
        """Index into the slots; None where the body lacks the role."""
        return self.slots.index(name) if name in self.slots else None

    def foot(self, side: int) -> str:
        """Name of a foot's link."""
        return self._last(SIDES[side], LEG)

    def _last(self, side: str, roles: tuple[str, ...]) -> str:
        return _last(self.slots, self.joint_of_slot, self.links, side, roles)

    def leg_joints(self, side: int) -> list[int]:
        """Joints of a leg."""
        names = [f"{SIDES[side]}_{role}" for role in LEG]
        return [int(self.joint_of_slot[self.slots.index(name)]) for name in names if name in self.slots]

    def by_slot(self, joint_pos: Array) -> Array:
        """Joint positions [..., joints] in canonical order and directions, [..., slots]."""
        taken: Array = joint_pos[..., self.joint_of_slot] * self.sign_of_slot
        return taken

    def by_joint(self, slots: Array) -> Array:
        """Positions by slot in the order of the joints, [..., joints]; inverts `by_slot`."""
        joints = np.broadcast_to(self.default, (*slots.shape[:-1], len(self.joints))).copy()
        joints[..., self.joint_of_slot] = slots * self.sign_of_slot
        return joints

    def qpos(self, motion: Motion) -> Array:
        """Positions of a motion, [frames, 7 + joints]; others stay in the default pose.

        Raises ConfigError for joints that the robot does not have.
        """
        if unknown := [name for name in motion.joint_names if name not in self.joints]:
            raise _core.ConfigError(
                f"{motion.name}: joint_names: {self.name} has no joint {unknown[0]!r}; it has "
                f"{', '.join(self.joints)}: name the motion's own robot, or retarget it"
            )
        joints = np.tile(self.default, (motion.frames, 1))
        joints[:, [self.joints.index(name) for name in motion.joint_names]] = motion.joint_pos
        return np.concatenate([motion.base_pos, motion.base_quat, joints], axis=1)

    def kinematics(self, qpos: Array) -> tuple[Array, Array]:
        """Positions and quaternions of all links, [frames, links, 3] and [frames, links, 4]."""
        sim = _simulation(self.source, len(qpos))
        sim.set_state(qpos=qpos)
        return sim.link_pose()

    def moving(self, qpos: Array, qvel: Array) -> tuple[Array, Array, Array, Array]:
        """`kinematics`, and linear and angular velocities of all links, world axes."""
        sim = _simulation(self.source, len(qpos))
        sim.set_state(qpos=qpos, qvel=qvel)
        return (*sim.link_pose(), *sim.link_velocity())

    def feet_gap(self, qpos: Array) -> Array:
        """Distance of each foot from the ground, m, [frames, 2]."""
        sim = _simulation(self.source, len(qpos))
        sim.set_state(qpos=qpos)
        gap: Array = sim.ground_gap()[:, [self.links.index(self.foot(side)) for side in range(2)]]
        return gap

    def effort(self, qpos: Array, qvel: Array, qacc: Array) -> Array:
        """Forces and moments that a motion takes without a ground, [frames, 6 + joints].

        The first three are a force at the base's origin, world axes, N; then a moment, base axes,
        N m.
        """
        sim = _simulation(self.source, len(qpos))
        sim.set_state(qpos=qpos, qvel=qvel)
        return sim.inverse_dynamics(qacc)

    def with_feet(self, qpos: Array, position: Array, orientation: Array) -> tuple[Array, Array]:
        """Moves the legs so that the feet have these poses: damped least squares within the limits.

        Args:
            qpos: [frames, 7 + joints], where it begins; other joints stay.
            position: [frames, 2, 3], m.
            orientation: [frames, 2, 4].

        Returns:
            The new positions, and the distances of the feet from their goals, [frames, 2], m.
        """
        sim = _simulation(self.source, len(qpos))
        qpos = qpos.copy()
        legs = [self.leg_joints(side) for side in range(2)]
        at = [self.links.index(self.foot(side)) for side in range(2)]
        turn_weight = TURN_WEIGHT if min(len(leg) for leg in legs) >= 6 else LOOSE_TURN_WEIGHT
        weights = np.array([1.0, 1.0, 1.0, turn_weight, turn_weight, turn_weight])
        for _ in range(ITERATIONS):
            sim.set_state(qpos=qpos)
            pos, quat = sim.link_pose()
            moved = 0.0
            for side in range(2):
                turn = rotations.vector(rotations.product(orientation[:, side], rotations.inverse(quat[:, at[side]])))
                error = np.concatenate([position[:, side] - pos[:, at[side]], turn], axis=1) * weights
                columns = [6 + joint for joint in legs[side]]
                jacobian = sim.jacobian(self.links[at[side]])[:, :, columns] * weights[:, np.newaxis]
                square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
                step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[..., np.newaxis])
                places = [7 + joint for joint in legs[side]]
                goal = qpos[:, places] + np.clip(step[..., 0], -LARGEST_STEP, LARGEST_STEP)
                goal = np.clip(goal, self.lower[legs[side]], self.upper[legs[side]])
                moved = max(moved, float(np.abs(goal - qpos[:, places]).max()))
                qpos[:, places] = goal
            if moved < TOLERANCE:
                break
        sim.set_state(qpos=qpos)
        pos, _ = sim.link_pose()
        return qpos, np.linalg.norm(position - pos[:, at], axis=-1)


def body_of(robot: str) -> Body:
    """A humanoid of the library, or of a config's path.

    Raises ConfigError for a robot without two legs of the roles of a humanoid.
    """
    return _body_of(str(robot))


@functools.lru_cache(maxsize=16)
def _body_of(robot: str) -> Body:
    sim = _core.VecSim(descriptions.TASK, 1, robots=[robot], threads=1, overrides=["env_shares=null"])
    (name,) = sim.robots
    info = simulated.robots(sim)[name]
    slots, of_slot = tuple(info["slots"]), np.array(info["joint_of_slot"], dtype=np.int64)
    for side in SIDES:
        for role in ("HIP_PITCH", "KNEE", "ANKLE_PITCH"):
            if f"{side}_{role}" not in slots:
                raise _core.ConfigError(
                    f"{name} has no joint of the role {side}_{role}; motions are of humanoids, such as unitree_g1"
                )
    joints, links = tuple(info["joint_names"]), tuple(sim.link_names(name))
    default = np.array(info["default_pose"], dtype=np.float64)
    lower, upper = np.array(info["lower"], dtype=np.float64), np.array(info["upper"], dtype=np.float64)
    lower, upper = np.where(np.isfinite(lower), lower, -np.pi), np.where(np.isfinite(upper), upper, np.pi)
    feet = [links.index(_last(slots, of_slot, links, side, LEG)) for side in SIDES]
    hips = [links.index(_link(slots, of_slot, links, f"{side}_HIP_PITCH")) for side in SIDES]
    rest = np.concatenate([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], default])
    straight = rest.copy()
    for side in SIDES:
        for role in LEG:
            if f"{side}_{role}" in slots:
                straight[7 + of_slot[slots.index(f"{side}_{role}")]] = 0.0
    kinematics = _simulation(robot, 2)
    kinematics.set_state(qpos=np.stack([rest, straight]))
    pos, quat = kinematics.link_pose()
    # soles are flat with straight legs, unless the legs are folded at zero
    is_flat = bool((rotations.angle(quat[0, feet], quat[1, feet]) < FLAT).all())
    soles = quat[1, feet] if is_flat else quat[0, feet]
    key = _key_links(slots, of_slot, links)
    body = Body(
        name=name,
        source=robot,
        joints=joints,
        links=links,
        slots=slots,
        joint_of_slot=of_slot,
        sign_of_slot=np.array(info["slot_signs"], dtype=np.float64),
        lower=lower,
        upper=upper,
        default=default,
        height=0.0,
        leg=0.0,
        feet=pos[0, feet],
        soles=soles,
        hands=tuple(_last(slots, of_slot, links, side, ARM) for side in SIDES if f"{side}_ELBOW" in slots),
        key_links=key,
        rest_point=np.zeros(2),
        lean=0.0,
    )
    flat, _ = body.with_feet(rest[np.newaxis], pos[:1, feet], soles[np.newaxis])
    height = -float(body.feet_gap(flat).min())
    up = np.array([0.0, 0.0, height])
    leg = float(pos[0, hips, 2].mean()) + height
    values = {**vars(body), "height": height, "leg": leg, "feet": pos[0, feet] + up, "default": flat[0, 7:]}
    single = _simulation(robot, 1)
    single.set_state(qpos=flat)
    point = single.center_of_mass()[0, :2].copy()
    ahead = float(point[0] - body.feet[:, 0].mean())
    effort = min(info["effort_limit"][of_slot[slots.index(f"{side}_ANKLE_PITCH")]] for side in SIDES)
    bearable = BEARABLE * effort / (GRAVITY * single.total_mass)
    return Body(**{**values, "rest_point": point, "lean": float(np.clip(ahead, -bearable, bearable)) - ahead})


@functools.lru_cache(maxsize=4)
def _simulation(robot: str, frames: int) -> _core.Simulation:
    return _core.Simulation(robot, frames, threads=1)


def _link(slots: tuple[str, ...], of_slot: npt.NDArray[np.int64], links: tuple[str, ...], slot: str) -> str:
    """Link that a joint moves: links follow the joints' order, the base first."""
    return links[1 + int(of_slot[slots.index(slot)])]


def _last(
    slots: tuple[str, ...], of_slot: npt.NDArray[np.int64], links: tuple[str, ...], side: str, roles: tuple[str, ...]
) -> str:
    """Last link of a limb."""
    joints = [int(of_slot[slots.index(f"{side}_{role}")]) for role in roles if f"{side}_{role}" in slots]
    return links[1 + max(joints)]


def _key_links(slots: tuple[str, ...], of_slot: npt.NDArray[np.int64], links: tuple[str, ...]) -> tuple[str, ...]:
    torso = [slot for slot in slots if slot.startswith("TORSO_")]
    found = [links[0]]
    if torso:
        found.append(links[1 + max(int(of_slot[slots.index(slot)]) for slot in torso)])
    for side in SIDES:
        found += [_link(slots, of_slot, links, f"{side}_{role}") for role in ("HIP_ROLL", "KNEE")]
        found.append(_last(slots, of_slot, links, side, LEG))
        arm = [role for role in ("SHOULDER_ROLL", "ELBOW") if f"{side}_{role}" in slots]
        found += [_link(slots, of_slot, links, f"{side}_{role}") for role in arm]
        if arm:
            found.append(_last(slots, of_slot, links, side, ARM))
    return tuple(dict.fromkeys(found))
