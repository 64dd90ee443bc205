"""Terms in Python of a task, over MuJoCo's state.

Commands, observations and terminations of a file read the same names as in polypod, and the same
memory and random streams. `State` and `env.sim` answer from MuJoCo's state; what a model does not
hold, or what would change polypod's simulator, is refused by name.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Floats
from polypod.python_terms import TermSim
from polypod.python_terms.env import TermEnv
from polypod.sim2sim.driven import Driven, FoldedPolicy, Observed

CONSTANT = frozenset(
    {
        "action_mask",
        "canonical_joint_names",
        "command_ranges",
        "contact_body_names",
        "env_ids",
        "env_origins",
        "feet_names",
        "gravity",
        "joint_map",
        "link_names",
        "max_episode_length",
        "num_actions",
        "num_envs",
        "parameters",
        "resolved_config",
        "robot_info",
        "robot_shapes",
        "robots",
        "seed",
        "step_dt",
        "task_name",
        "terrain",
        "terrain_tiles",
    }
)
"""Names of `env.sim` that an episode does not change: polypod's simulator answers."""
KINEMATICS = frozenset({"feet_pos", "feet_height", "feet_vel"})
"""Fields of `State` that polypod computes from the positions and velocities of MuJoCo."""
REFUSED = {
    "joint_acc": "accelerations of a physics step depend on the simulator",
    "contact_forces": "its contacts are not those of polypod's feet",
    "feet_air_time": "its contacts are not those of polypod's feet",
    "feet_contact_time": "its contacts are not those of polypod's feet",
}
"""Fields of `State` that are not answered, and why."""


class _State:
    """`VecSim.state` of the envs that MuJoCo steps; other rows stay as the episode began."""

    def __init__(self, sim: TermSim, robot: str) -> None:
        self._sim, self._robot = sim, robot
        self.rows = slice(*sim.env_ids(robot))
        self._begin: dict[str, npt.NDArray[np.float32]] = {}
        self.driven: Driven | None = None
        self.command: npt.NDArray[np.float32] = sim.state("command").copy()
        self.previous = np.zeros((sim.num_envs, sim.num_actions), dtype=np.float32)
        self.episode_length: npt.NDArray[np.int64] = np.zeros(sim.num_envs, dtype=np.int64)
        self.action_mask = sim.action_mask
        self._is_written = False

    def clear(self) -> None:
        """Reads everything again."""
        self._is_written = False

    def state(self, field: str) -> npt.NDArray[np.float32]:
        """See `VecSim.state`. Raises ConfigError for what MuJoCo's state does not hold."""
        if field in REFUSED:
            raise _core.ConfigError(
                f"{field}: MuJoCo does not answer it, since {REFUSED[field]}; see docs/write-a-term.md"
            )
        if field in KINEMATICS:
            self.write()
            return self._sim.state(field)
        if field == "command":
            return self.command.copy()
        whole = self._initial(field).copy()
        values = self._values().get(field)
        if values is not None:
            whole[self.rows] = values()
        return whole

    def _initial(self, field: str) -> npt.NDArray[np.float32]:
        found = self._begin.get(field)
        if found is None:
            found = self._begin[field] = self._sim.state(field)
        return found

    def _values(self) -> dict[str, Callable[[], Any]]:
        driven = self.driven
        if driven is None:
            return {}
        gather, lever = driven.interface.gather(), driven.interface.lever()
        linear, rate = driven.base_velocity()
        return {
            "base_pos": lambda: driven.qpos[:, :3],
            "base_height": lambda: driven.base_height()[:, np.newaxis],
            "base_quat": lambda: driven.qpos[:, 3:7],
            "base_lin_vel": lambda: linear + rate @ lever,
            "base_ang_vel": lambda: rate,
            "projected_gravity": driven.projected_gravity,
            "joint_pos": lambda: driven.qpos[:, 7:] @ gather,
            "joint_vel": lambda: driven.qvel[:, 6:] @ gather,
            "joint_effort": lambda: driven.joint_effort() @ gather,
            "last_action": lambda: driven.actions,
            "previous_action": lambda: self.previous[self.rows],
            "valid": lambda: self.valid()[:, np.newaxis],
        }

    def valid(self) -> npt.NDArray[np.bool_]:
        """Whether MuJoCo's state is finite, [envs of the robot]."""
        assert self.driven is not None
        state = np.concatenate([self.driven.qpos, self.driven.qvel], axis=1)
        valid: npt.NDArray[np.bool_] = np.isfinite(state).all(axis=1)
        return valid

    def write(self) -> None:
        """Gives positions and velocities to polypod's simulator, which computes feet and links.

        Joints that the task does not drive keep the positions in which the episode began there.
        """
        if self._is_written or self.driven is None:
            return
        at = self.rows.start + np.flatnonzero(self.valid())
        fields = ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel", "joint_pos", "joint_vel")
        self._sim.set_state(at, **{field: self.state(field)[at] for field in fields})
        self._is_written = True


class _Simulator:
    """`env.sim` as the terms see it."""

    def __init__(self, sim: TermSim, state: _State) -> None:
        self._sim, self._state = sim, state

    def __getattr__(self, name: str) -> Any:
        if name in CONSTANT:
            return getattr(self._sim, name)
        if name == "command":
            return self._state.command.copy()
        if name == "state":
            return self._state.state
        if name in ("links", "link_pose"):
            self._state.write()
            return self._links if name == "links" else self._sim.link_pose
        raise _core.ConfigError(
            f"env.sim.{name}: it is of polypod's simulator, and MuJoCo steps here; terms that sim2sim takes read "
            "`State`, commands, memory, random streams, and of env.sim what does not change, links and link_pose"
        )

    def _links(self, robot: str, names: Any = None) -> Mapping[str, Any]:
        found = dict(self._sim.links(robot, names))
        found.pop("contact_force")
        return _Links(found)


class _Links(dict[str, Any]):
    """Poses and velocities of links."""

    def __missing__(self, key: str) -> Any:
        raise _core.ConfigError(f"links: {key}: MuJoCo does not answer it; there are {', '.join(self)}")


class _View(TermEnv):
    """All envs as the terms see them."""

    def __init__(self, sim: TermSim, state: _State) -> None:
        own = sim.view
        super().__init__(sim, sim, own.commands, own.memory, own.random)
        shown: Any = state
        self._sim = lambda: shown
        self._gathered = shown
        simulator: Any = _Simulator(sim, state)
        self.sim = simulator


class OwnTerms:
    """Commands, observations and terminations in Python of one robot that MuJoCo steps."""

    def __init__(self, sim: TermSim, robot: str) -> None:
        """Takes over a simulator whose episodes have just begun."""
        self.sim = sim
        self._state = _State(sim, robot)
        self._values: dict[str, npt.NDArray[np.float32]] = {}
        self._names = set(sim.observed())
        sim.look_at(_View(sim, self._state))

    def policy(self, policy: FoldedPolicy) -> FoldedPolicy:
        """The policy with the values of the terms as inputs."""
        return _WithTerms(policy, self)

    def begin(self, driven: Driven) -> None:
        """Sees the robots after their reset. Raises ConfigError for a term without answer."""
        self._state.driven = driven
        self._observe()
        self.sim.ended()  # terminations without answer are refused before the episode

    def step(self, driven: Driven, commands: npt.NDArray[np.float32], active: npt.NDArray[np.bool_]) -> Observed:
        """One control step, see `Driven.step`; terminations of the terms are falls."""
        state = self._state
        state.command[state.rows] = commands
        self.sim.before_physics()
        state.previous[state.rows] = driven.actions
        seen = driven.step(commands, active)
        state.episode_length += 1
        ends, _ = self.sim.after_physics()
        self._observe()
        return Observed(seen.velocity, seen.yaw_rate, seen.fell | (ends[False][state.rows] & active))

    def inputs(self) -> dict[str, Floats]:
        """Values of the terms, [envs of the robot, width]."""
        return {name: values[self._state.rows] for name, values in self._values.items()}

    @property
    def names(self) -> set[str]:
        """Names of the terms that the policy observes."""
        return self._names

    def _observe(self) -> None:
        self.sim.view.refresh()
        self._values = self.sim.observed()


class _WithTerms:
    """A folded policy that is given the terms in addition to the robot's sensors."""

    def __init__(self, policy: FoldedPolicy, terms: OwnTerms) -> None:
        self._policy, self._terms = policy, terms

    @property
    def inputs(self) -> Mapping[str, int]:
        """Inputs that sensors give."""
        return {name: size for name, size in self._policy.inputs.items() if name not in self._terms.names}

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        """Adds the values of the terms."""
        own = {name: value for name, value in self._terms.inputs().items() if name in self._policy.inputs}
        return self._policy(**inputs, **own)

    def reset(self) -> None:
        """Forgets what all envs have seen."""
        self._policy.reset()


__all__ = ["CONSTANT", "KINEMATICS", "REFUSED", "OwnTerms"]
