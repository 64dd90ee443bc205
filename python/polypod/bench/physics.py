"""Physics alone: `polypod.Simulation`, `mujoco.rollout`, `mujoco.batch` and MuJoCo Warp.

All step the same robot towards the same targets.

All have the URDF, the gains, the rotor inertias, the physics step and the number of threads; MuJoCo
has its standard settings of solver and contacts, which are its fastest. Targets, drawn before
anything is timed, change every 20 ms about the default pose, so that the robots tread on the spot.

`rollout` runs trajectories from states that the caller holds. `batch`, of MuJoCo 3.17 and newer,
keeps the simulations and their warm starts between calls. MuJoCo Warp steps on an NVIDIA card, four
physics steps as one graph.
"""

import importlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from polypod import _core, simulated
from polypod.arrays import Array
from polypod.bench.sampling import Sample
from polypod.extras import package
from polypod.mujoco_model import robot as robots
from polypod.mujoco_model.reference import Ground, Reference, mujoco, states

DT = 0.005
"""Physics step, s."""
HOLD = 4
"""Physics steps between two changes of the targets."""
SPREAD = 0.15
"""Half width of the targets about the default pose, rad."""
FRICTION = 0.8
SETTLE = 25
"""Changes of the targets before anything is timed."""
DRAWS = 32
"""Targets that follow each other; then they begin again."""


def _targets(robot: robots.Robot, num_envs: int, seed: int) -> Iterator[Array]:
    spread = np.random.default_rng(seed).uniform(-SPREAD, SPREAD, (DRAWS, num_envs, robot.num_joints))
    return itertools.cycle(robot.default_position + spread)


def polypod(name: str, num_envs: int, threads: int, seed: int, engine: str = "articulated") -> Sample:
    """Steps every env for 20 ms, all shapes touching the ground.

    Links of the robot do not touch each other, as in MuJoCo.
    """
    robot = robots.load(name)
    sim = _core.Simulation(
        name, num_envs, dt=DT, threads=threads, friction=FRICTION, engine=engine, self_collision=False
    )
    targets = _targets(robot, num_envs, seed)

    def sample() -> int:
        sim.step(targets=next(targets), n=HOLD)
        return num_envs * HOLD

    for _ in range(SETTLE):
        sample()
    return sample


def rollout(name: str, num_envs: int, threads: int, seed: int, iterations: int | None = None) -> Sample:
    """Makes the sample of `mujoco.rollout`, with contacts of the feet only.

    Args:
        name: of the robot.
        num_envs: number of envs.
        threads: number of threads.
        seed: of the targets.
        iterations: of MuJoCo's solver; None: its standard, until it has converged.
    """
    mj_rollout = package("mujoco.rollout", "comparing with MuJoCo", "bench")
    mj, robot, reference, order = _mujoco(name, iterations)
    model = reference.model
    data = states(model, threads, "--threads")
    full = mj.mjtState.mjSTATE_FULLPHYSICS
    size = mj.mj_stateSize(model, full)
    start = np.zeros(size)
    mj.mj_getState(model, reference.data, start, full)
    state = np.tile(start, (num_envs, 1))
    runner = mj_rollout.Rollout(nthread=threads)
    targets = _targets(robot, num_envs, seed)
    out = np.zeros((num_envs, HOLD, size))

    def sample() -> int:
        control = np.repeat(next(targets)[:, None, order], HOLD, axis=1)
        runner.rollout(model, data, state, control, nstep=HOLD, state=out, skip_checks=False)
        np.copyto(state, out[:, -1])
        return num_envs * HOLD

    return _settled(sample, lambda: state, name)


def batch(name: str, num_envs: int, threads: int, seed: int) -> Sample | None:
    """Makes the sample of `mujoco.batch`, as `rollout` does.

    None where the installed MuJoCo is older than 3.17 and lacks it.

    Args:
        name: of the robot.
        num_envs: number of envs.
        threads: number of threads.
        seed: of the targets.
    """
    mujoco()
    try:
        mj_batch = importlib.import_module("mujoco.batch")
    except ModuleNotFoundError as error:
        if error.name != "mujoco.batch":
            raise
        return None
    _, robot, reference, order = _mujoco(name, None)
    simulations = mj_batch.Batch(reference.model, num_envs, threads)
    qpos, control = simulations.bind("qpos"), simulations.bind("ctrl")
    qpos[:] = reference.data.qpos
    targets = _targets(robot, num_envs, seed)

    def sample() -> int:
        control[:] = next(targets)[:, order]
        simulations.step(nstep=HOLD)
        return num_envs * HOLD

    return _settled(sample, lambda: simulations.state, name)


def warp(name: str, num_envs: int, seed: int, device: str | None = None) -> Sample | None:
    """Makes the sample of MuJoCo Warp, as `rollout` does.

    None where the package `mujoco-warp` is not installed, or finds no card.

    Args:
        name: of the robot.
        num_envs: number of envs.
        seed: of the targets.
        device: of Warp; None: the first card.

    Raises:
        ConfigError: where Warp has less room for contacts than the robots need.
    """
    mujoco()
    try:
        mjw, wp = importlib.import_module("mujoco_warp"), importlib.import_module("warp")
    except ModuleNotFoundError as error:
        if error.name not in {"mujoco_warp", "warp"}:
            raise
        return None
    if device is None and not wp.is_cuda_available():
        return None
    _, robot, reference, order = _mujoco(name, None)
    targets = _targets(robot, num_envs, seed)
    with wp.ScopedDevice(device or "cuda:0") as place:
        model = mjw.put_model(reference.model)
        data = mjw.put_data(reference.model, reference.data, nworld=num_envs)

        def steps() -> None:
            for _ in range(HOLD):
                mjw.step(model, data)

        start = {name: wp.clone(getattr(data, name)) for name in ("qpos", "qvel", "qacc_warmstart", "time")}
        # kernels are compiled before they are recorded
        steps()
        graph = None
        if place.is_cuda:
            with wp.ScopedCapture(device=place) as capture:
                steps()
            graph = capture.graph
        for part, numbers in start.items():
            wp.copy(getattr(data, part), numbers)

    def sample() -> int:
        data.ctrl.assign(next(targets)[:, order].astype(np.float32))
        if graph is None:
            steps()
        else:
            wp.capture_launch(graph)
        wp.synchronize_device(place)
        return num_envs * HOLD

    _settled(sample, data.qpos.numpy, name)
    if data.overflow.numpy().any():
        raise _core.ConfigError(f"MuJoCo Warp has too little room for the contacts of {name}: compare another --robot")
    return sample


def _mujoco(name: str, iterations: int | None) -> tuple[Any, robots.Robot, Reference, list[int]]:
    """MuJoCo, the robot, its model in the default pose, and the joint of each actuator.

    Joints are places in polypod's order.
    """
    mj = mujoco()
    robot = robots.load(name)
    reference = Reference.of(robot, dt=DT, integrator="implicitfast", ground=Ground(FRICTION))
    _standard_solver(mj, reference.model, name, iterations)
    reference.set_state(np.concatenate([[0.0, 0.0, robot.base_height, 1.0, 0.0, 0.0, 0.0], robot.default_position]))
    return mj, robot, reference, _actuator_order(reference.model, robot.joint_names)


def _settled(sample: Sample, state: Callable[[], Array], name: str) -> Sample:
    """The sample after `SETTLE` calls.

    Raises ConfigError where MuJoCo's state is not finite then.
    """
    for _ in range(SETTLE):
        sample()
    if not np.isfinite(state()).all():
        raise _core.ConfigError(f"MuJoCo diverged on {name}: the comparison would mean nothing")
    return sample


def _standard_solver(mj: Any, model: Any, name: str, iterations: int | None) -> None:
    """Undoes the stiff contacts of accuracy comparisons, and leaves contacts to the feet."""
    model.opt.cone = mj.mjtCone.mjCONE_PYRAMIDAL
    model.opt.impratio = 1.0
    model.geom_solref[:] = [0.02, 1.0]
    model.geom_solimp[:] = [0.9, 0.95, 0.001, 0.5, 2.0]
    model.dof_solref[:] = [0.02, 1.0]
    model.dof_solimp[:] = [0.9, 0.95, 0.001, 0.5, 2.0]
    if iterations is not None:
        model.opt.iterations = iterations
    feet = _feet(name)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body != 0 and not _belongs(model, body, feet):
            model.geom_contype[geom] = 0


def _feet(name: str) -> list[str]:
    sim = _core.VecSim(robots.TASK, 1, robots=[name], threads=1)
    return list(simulated.robots(sim)[name]["feet"])


def _belongs(model: Any, body: int, names: list[str]) -> bool:
    while body != 0:
        if model.body(body).name in names:
            return True
        body = int(model.body_parentid[body])
    return False


def _actuator_order(model: Any, joint_names: tuple[str, ...]) -> list[int]:
    """Places of the joints of MuJoCo's actuators in polypod's order."""
    return [joint_names.index(model.actuator(index).name) for index in range(model.nu)]
