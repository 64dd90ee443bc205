"""A wheel, installed outside the checkout, is small and makes the shipped policy walk."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from common import ROOT
from polypod.bundled import NAMES, PRETRAINED

sys.path.insert(0, str(ROOT / "tools"))
import ptx

MOST_BYTES = 19_400_000
"""10 MB of them are the extension, 7 MB the bundled policies, 0.7 MB kernels of a card."""


@pytest.fixture(scope="module")
def wheel() -> Path:
    wheels = sorted((ROOT / "dist").glob("polypod-*.whl"))
    assert len(wheels) == 1, f"{wheels} in dist/: build one with `make wheel`"
    return wheels[0]


def has_nvrtc() -> bool:
    try:
        return ptx.find_nvrtc() is not None
    except ptx.MissingNvrtcError:
        return False


def test_it_holds_the_package_and_nothing_else(wheel: Path) -> None:
    assert wheel.stat().st_size <= MOST_BYTES
    assert "-abi3-" in wheel.name
    names = zipfile.ZipFile(wheel).namelist()
    folders = {name.split("/")[0] for name in names}
    assert len(folders) == 2, folders
    assert all(folder == "polypod" or folder.endswith(".dist-info") for folder in folders)
    assert any(name.startswith("polypod/_core.") for name in names)
    shared = {"__init__.py", "__pycache__", "accuracy", "networks.py"}
    laboratory = {path.name for path in (ROOT / "lab").iterdir()} - shared
    laboratory |= {f"accuracy/{name}.py" for name in ("engines", "friction", "markdown", "sweeps")}
    assert laboratory
    shipped = [name.removeprefix("polypod/") for name in names if name.startswith("polypod/")]
    assert laboratory.isdisjoint([*shipped, *(name.split("/")[0] for name in shipped)])
    suffixes = {Path(name).suffix for name in names if name.startswith("polypod/")}
    assert suffixes <= {".py", ".pyi", ".so", ".pyd", ".typed", "", ".pt", ".json", ".onnx", ".toml", ".hpp", ".ptx"}
    for folder in (*NAMES.values(), *PRETRAINED.values()):
        of_policy = {Path(name).name for name in names if name.startswith(f"polypod/policies/{folder}/model_")}
        assert len(of_policy) == 1
        assert f"polypod/policies/{folder}/manifest.json" in names
    # files that `polypod deploy write` copies for a robot
    for name in ("deploy/onboard/policy_loop.py", "deploy/onboard/policy_loop.hpp", "export/contract.schema.json"):
        assert f"polypod/{name}" in names
    assert "polypod/export/motors.json" in names
    # a machine with NVRTC makes kernels of a card
    kernels = {name for name in names if name.startswith("polypod/kernels/")}
    assert kernels == ({f"polypod/kernels/{name}" for name in ptx.programs()} if has_nvrtc() else set())


def test_the_shipped_policy_walks_from_it(wheel: Path, tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    subprocess.run(["make", "-s", "-C", str(ROOT), ".wheel-venv", f"WHEEL={wheel}", f"INTO={venv}"], check=True)
    polypod = venv / ("Scripts" if os.name == "nt" else "bin") / "polypod"
    where = "import polypod; print(polypod.__file__)"
    python = polypod.with_name(Path(sys.executable).name)
    environment = {key: value for key, value in os.environ.items() if key not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "check": True}
    found = subprocess.run([python, "-c", where], **options).stdout
    assert Path(found.strip()).is_relative_to(venv)
    played = subprocess.run([polypod, "play", "--headless", "--seconds", "1"], **options).stdout
    assert "Velocity-Flat-Universal-Play-v0" in played
    arguments = ["eval", "--checkpoint", "flat", "--num-envs", "16", "--json", "walked.json"]
    subprocess.run([polypod, *arguments], **options)
    walked = json.loads((tmp_path / "walked.json").read_text())["robots"]
    # the checkout's figures, to the bit: no file is missing or another
    subprocess.run([sys.executable, "-m", "polypod", *arguments], **options)
    assert walked == json.loads((tmp_path / "walked.json").read_text())["robots"]
    assert len(walked) == 8
    for name, robot in walked.items():
        assert robot["error_vel_xy"] < 0.5 * robot["still_error_vel_xy"], name
