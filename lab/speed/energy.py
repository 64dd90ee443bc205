"""Energy counters of a machine.

Linux's powercap files for processors, `nvidia-smi` for NVIDIA's GPUs.
"""

import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import IO

POWERCAP = Path("/sys/class/powercap")
"""Where Linux shows the energy counters of processors (RAPL)."""
SAMPLE_S = 0.5
"""Time between two samples of a GPU's power."""
PROCESSORS, GPUS = "processors", "GPUs"
_JOULES_PER_WATT_HOUR = 3600.0


class Meter:
    """Adds up the energy of readable processors and GPUs between `resume` and `pause`."""

    def __init__(self, gpus: bool = False, powercap: Path = POWERCAP) -> None:
        """Stands still until `resume`.

        Args:
            gpus: also count GPUs.
            powercap: folder of the processors' counters.
        """
        self._powercap = powercap
        self._program = shutil.which("nvidia-smi") if gpus else None
        self._joules: dict[str, float] = {}
        self._began: dict[Path, int] = {}
        self._since = 0.0
        self._sampler: subprocess.Popen[bytes] | None = None
        self._samples: IO[bytes] | None = None

    def resume(self) -> None:
        """Counts from here on."""
        self._began = self._counters()
        self._since = time.perf_counter()
        if self._program is not None:
            query = [self._program, "--query-gpu=index,power.draw", "--format=csv,noheader,nounits"]
            self._samples = tempfile.TemporaryFile()  # noqa: SIM115
            try:
                self._sampler = subprocess.Popen(
                    [*query, f"--loop-ms={round(1000 * SAMPLE_S)}"], stdout=self._samples, stderr=subprocess.DEVNULL
                )
            except OSError:
                self._sampler = None

    def pause(self) -> None:
        """Stands still from here on."""
        elapsed, now = time.perf_counter() - self._since, self._counters()
        for path, begin in self._began.items():
            if path not in now:
                continue
            used = now[path] - begin
            if used < 0:  # the counter began again
                used += _number(path.with_name("max_energy_range_uj")) or 0
            self._joules[PROCESSORS] = self._joules.get(PROCESSORS, 0.0) + used * 1e-6
        self._began = {}
        if self._sampler is not None and self._samples is not None:
            self._sampler.terminate()
            self._sampler.wait()
            self._samples.seek(0)
            watts = _watts(self._samples.read().decode(errors="replace"))
            if watts is not None:
                self._joules[GPUS] = self._joules.get(GPUS, 0.0) + watts * elapsed
            self._samples.close()
        self._sampler = self._samples = None

    def watt_hours(self) -> dict[str, float]:
        """Energy until the last pause, by `PROCESSORS` and `GPUS`.

        Counters that the machine does not show are left out.
        """
        return {name: joules / _JOULES_PER_WATT_HOUR for name, joules in self._joules.items()}

    def _counters(self) -> dict[Path, int]:
        """Microjoules of each package, in which its parts are included."""
        files = (zone / "energy_uj" for zone in self._powercap.glob("intel-rapl:*") if zone.name.count(":") == 1)
        found = {path: _number(path) for path in files}
        return {path: number for path, number in found.items() if number is not None}


def _number(path: Path) -> int | None:
    """The number in a file; None where it cannot be read.

    Most machines show counters to the administrator alone.
    """
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _watts(output: str) -> float | None:
    """Mean power of all GPUs together; None without a sample.

    A sample has a line "index, watts" for each GPU.

    A GPU that does not tell its power, "[N/A]", counts nothing.
    """
    powers: dict[str, list[float]] = {}
    # the last line may be half written
    for line in output.split("\n")[:-1]:
        index, _, power = line.partition(",")
        try:
            powers.setdefault(index.strip(), []).append(float(power))
        except ValueError:
            continue
    found = [sum(of) / len(of) for of in powers.values() if of]
    return sum(found) if found else None
