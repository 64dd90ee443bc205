"""Energy as the machine tells it.

Counters that begin again or need rights, and samples of power.
"""

import time
from types import SimpleNamespace

import pytest

from lab.speed import energy
from lab.speed.energy import GPUS, PROCESSORS, Meter


def package(folder, name, microjoules, most=10_000_000):
    zone = folder / name
    zone.mkdir(exist_ok=True)
    (zone / "energy_uj").write_text(f"{microjoules}\n")
    (zone / "max_energy_range_uj").write_text(f"{most}\n")


def test_packages_add_up_between_resume_and_pause(tmp_path):
    meter = Meter(powercap=tmp_path)
    package(tmp_path, "intel-rapl:0", 1_000_000)
    package(tmp_path, "intel-rapl:1", 9_000_000)
    package(tmp_path, "intel-rapl:0:0", 0)  # the cores, which the package includes
    meter.resume()
    package(tmp_path, "intel-rapl:0", 4_600_000)
    package(tmp_path, "intel-rapl:1", 2_600_000)  # began again at 10 J
    package(tmp_path, "intel-rapl:0:0", 3_000_000)
    meter.pause()
    assert meter.watt_hours() == pytest.approx({PROCESSORS: 7.2 / 3600.0})
    # standing still
    package(tmp_path, "intel-rapl:0", 9_000_000)
    meter.pause()
    meter.resume()
    meter.pause()
    assert meter.watt_hours() == pytest.approx({PROCESSORS: 7.2 / 3600.0})


def test_a_machine_that_tells_nothing_is_told_nothing_of(tmp_path):
    meter = Meter(powercap=tmp_path / "nothing")
    meter.resume()
    meter.pause()
    assert meter.watt_hours() == {}
    (tmp_path / "intel-rapl:0").mkdir()
    (tmp_path / "intel-rapl:0" / "energy_uj").write_text("no number")
    meter = Meter(powercap=tmp_path)
    meter.resume()
    meter.pause()
    assert meter.watt_hours() == {}


def test_the_power_of_gpus_is_sampled(tmp_path, monkeypatch):
    script = tmp_path / "nvidia-smi"
    script.write_text("#!/bin/sh\nprintf '0, 100.0\\n1, [N/A]\\n0, 300.0\\n0, 9'\nexec sleep 60\n")
    script.chmod(0o755)
    monkeypatch.setattr(energy, "shutil", SimpleNamespace(which=lambda name: str(script)))
    times = iter([0.0, 36.0])
    monkeypatch.setattr(energy, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    meter = Meter(gpus=True, powercap=tmp_path / "nothing")
    meter.resume()
    while meter._samples.seek(0, 2) < len("0, 100.0\n1, [N/A]\n0, 300.0\n0, 9"):
        time.sleep(0.01)
    meter.pause()
    assert meter.watt_hours() == pytest.approx({GPUS: 2.0})
