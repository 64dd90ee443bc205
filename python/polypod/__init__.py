"""polypod: thousands of different legged robots in one batch, on ordinary CPUs.

>>> import polypod
>>> env = polypod.make("Velocity-Flat-HeteroQuadruped-v0", num_envs=4096)
>>> observations, infos = env.reset(seed=0)

`polypod.Simulation` is the physics alone, for any URDF:

>>> sim = polypod.Simulation("unitree_go2", num_envs=16)
>>> sim.step(targets=sim.default_qpos[7:], n=200)

Importing polypod also registers its tasks with Gymnasium, as `polypod/<task>`. `polypod.rsl_rl`
holds the adapter for rsl_rl; it needs the `train` extra, as do the commands that train policies or
run them (`polypod --help`).
"""

from polypod._core import (
    ConfigError,
    PolypodError,
    RobotError,
    Simulation,
    UnknownNameError,
    VecSim,
    __version__,
    info,
    robot_urdf,
    robots,
    tasks,
)
from polypod.registration import register_tasks
from polypod.state import State
from polypod.vector_env import VectorEnv, make

__all__ = [
    "ConfigError",
    "PolypodError",
    "RobotError",
    "Simulation",
    "State",
    "UnknownNameError",
    "VecSim",
    "VectorEnv",
    "__version__",
    "info",
    "make",
    "robot_urdf",
    "robots",
    "tasks",
]

register_tasks()
