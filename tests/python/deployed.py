"""Exports of all bundled policies, and simulated robots, for tests of deployed policies."""

import json
import shutil
from pathlib import Path

import numpy as np

from common import SMALL_TERRAIN
from polypod import bundled
from polypod.export import export_checkpoint

POLICIES = {
    "flat": ["unitree_go2", "unitree_a1"],
    "rough": ["unitree_go2"],
    "legged": ["unitree_g1", "unitree_h1", "cassie"],
    "quadruped": ["unitree_go2"],
}
"""Robots by bundled policy."""
CASES = [(policy, robot) for policy, robots in POLICIES.items() for robot in robots]


def fill(folder: Path) -> None:
    """Exports every bundled policy for its robots.

    The rough task has little ground: none of it is in the files.
    """
    assert POLICIES.keys() == bundled.NAMES.keys()
    for policy, robots in POLICIES.items():
        checkpoint = bundled.checkpoint(policy)
        if policy == "rough":
            run = folder / "run"
            run.mkdir()
            manifest = json.loads((checkpoint.parent / "manifest.json").read_text(encoding="utf-8"))
            manifest["overrides"] = [*manifest["overrides"], *SMALL_TERRAIN]
            (run / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
            checkpoint = Path(shutil.copy(checkpoint, run))
        export_checkpoint(checkpoint, folder / policy, robots, formats=("onnx",))


def readings(contract, random):
    """Keywords of `Sensors` for a robot that leans a little, its joints within their limits."""
    lower = np.array([max(joint.lower, joint.default_pos - 0.5) for joint in contract.joints])
    upper = np.array([min(joint.upper, joint.default_pos + 0.5) for joint in contract.joints])
    quaternion = np.array([1.0, *(0.15 * random.standard_normal(3))])
    return {
        "joint_pos": random.uniform(lower, upper).astype(np.float32).astype(np.float64),
        "joint_vel": random.standard_normal(len(lower)).astype(np.float32).astype(np.float64),
        "quaternion": (quaternion / np.linalg.norm(quaternion)).astype(np.float32).astype(np.float64),
        "angular_velocity": random.standard_normal(3).astype(np.float32).astype(np.float64),
        "linear_velocity": random.standard_normal(3) if "base_lin_vel" in contract.sensed else None,
        "height_scan": random.uniform(0.0, 0.6, contract.num_rays) if contract.num_rays else None,
    }
