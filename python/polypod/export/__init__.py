"""Trained policies for use elsewhere: ONNX and TorchScript graphs with a complete manifest.

`polypod export` writes `policy.onnx`, `policy.pt` and `policy.json`: the network from observations
to actions, both as the task has them. Folded for a robot, `policy_<robot>.*` takes what the robot's
own sensors and joints read and gives joint targets. It needs the `export` extra.
"""

from polypod.export.checkpoint import Export, export_checkpoint
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy

__all__ = ["Export", "OnnxPolicy", "RobotInterface", "export_checkpoint", "interfaces"]
