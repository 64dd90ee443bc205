"""What `polypod robot new` and `polypod add` print about a drafted robot."""

import sys

from polypod.new_robot import CARRIED, NUM_ENVS, SECONDS, NewRobot


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
    """The command that trains the robot, under the name or path `robot`."""
    others = "" if new.is_quadruped else "--train-config specialist "
    return f"polypod train {others}--robots {robot}"
