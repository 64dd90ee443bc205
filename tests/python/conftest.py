"""What the tests share."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polypod
from common import TASK


@pytest.fixture
def make() -> Iterator[Callable[..., polypod.VectorEnv]]:
    """`polypod.make` with small defaults; the envs are closed afterwards."""
    envs = []

    def build(num_envs: int = 16, seed: int = 1, **arguments: Any) -> polypod.VectorEnv:
        env = polypod.make(TASK, num_envs=num_envs, seed=seed, **arguments)
        envs.append(env)
        return env

    yield build
    for env in envs:
        env.close()


@pytest.fixture
def actions() -> Callable[..., np.ndarray]:
    """Draws random actions, the same for the same arguments."""

    def draw(env: polypod.VectorEnv, step: int, scale: float = 1.0) -> np.ndarray:
        random = np.random.default_rng(step)
        return (scale * random.standard_normal(env.action_space.shape)).astype(np.float32)

    return draw


@pytest.fixture
def cli(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs `polypod` with the given arguments in a temporary directory, or in `cwd`."""

    def run(*arguments: str, cwd: Path = tmp_path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "polypod", *arguments]
        return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=170, check=False)

    return run
