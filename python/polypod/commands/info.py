"""`polypod info`."""

import dataclasses
import os
import platform
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from polypod import _core

PACKAGES = ("numpy", "gymnasium", "torch", "rsl-rl-lib", "tensordict", "mujoco", "onnxruntime", "viser", "tyro")
"""Distributions whose versions a bug report needs."""
VARIABLES = ("POLYPOD_PATH", "POLYPOD_SIMD", "POLYPOD_NVRTC", "OMP_NUM_THREADS", "GOMP_SPINCOUNT")
"""Environment variables that change what polypod does."""
_TIMEOUT_S = 10.0
"""Time for the driver of the GPUs to answer, s."""


@dataclasses.dataclass(frozen=True)
class Info:
    """Show what a bug report needs: versions, machine, threads, GPUs, folders of configs."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        for key, value in report().items():
            print(f"{key:<12} {value}")
        return 0


def report() -> dict[str, str]:
    """Versions of polypod and its packages, the machine, and polypod's environment variables."""
    from polypod.provenance import cpu, git_state

    core, state = _core.info(), git_state()
    commit = "" if state is None else f", commit {state['commit'][:9]}{'+' * state['dirty']}"
    gpus = _gpus()
    return {
        "version": core["version"] + commit,
        "simd": core["simd"],
        "threads": str(core["threads"]),
        "python": f"{platform.python_version()}, {sys.executable}",
        "system": platform.platform(),
        "processor": f"{cpu()}, {os.cpu_count()} cores",
        **{f"gpu {i}": gpu for i, gpu in enumerate(gpus)},
        **({} if gpus else {"gpu": "none found"}),
        "cuda engine": _core.cuda(),
        **{name: _version(name) for name in PACKAGES},
        **{name: os.environ[name] for name in VARIABLES if name in os.environ},
        "tasks": f"{len(_core.tasks())}, robots {len(_core.robots())}, broken configs {len(_core.broken_configs())}",
        "package": str(Path(_core.__file__ or __file__).parent),
    }


def _version(name: str) -> str:
    """The version; torch's tells the CUDA that it was built for."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _gpus() -> list[str]:
    """Names and driver versions of NVIDIA's GPUs; without importing torch, which takes seconds."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    query = [program, "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.SubprocessError):
        return []
    return done.stdout.splitlines() if done.returncode == 0 else []
