"""`polypod export`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core
from polypod.commands.arguments import RobotNames, arg, check_names, names


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a trained policy as ONNX and TorchScript, with a manifest; needs the extra export."""

    checkpoint: Path
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Directory to write. Default: exported/ next to the checkpoint."""
    robots: RobotNames = None
    """Names of robots, with commas between: also write a graph for each, from its sensors to its
    joint targets."""
    fold: bool = False
    """Write such a graph for each robot that the policy was trained on."""
    formats: Annotated[tuple[Literal["onnx", "torchscript"], ...], arg(metavar="FORMAT")] = ("onnx", "torchscript")
    """Kinds of files to write."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(None, names(self.robots))
        from polypod import runs
        from polypod.export import export_checkpoint

        if not self.formats:
            raise _core.ConfigError("--formats names none; choose onnx, torchscript or both")
        done = export_checkpoint(
            runs.resolve(self.checkpoint), self.out, names(self.robots), fold=self.fold, formats=self.formats
        )
        for change in done.changes:
            print(f"polypod: warning: {change}", file=sys.stderr)
        for file in done.files:
            print(file)
        if "onnx" in self.formats:
            print(f"onnxruntime differs from torch by at most {done.difference:.1e}")
        return 0
