"""Fixtures that the tests share."""

import contextlib
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

import polypod
import polypod.__main__
from common import FLAT_POLICY, ROBOTS, ROOT, TASK, TINY

Finished = subprocess.CompletedProcess[str]

# pytest runs a worker per core. Torch reads this when it is imported, here and in processes that
# tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# nohup lets tests ignore hangups, and the processes that they start and hang up
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_addoption(parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager) -> None:
    """Accepts pytest-xdist's options of `pyproject.toml` where it is absent or switched off."""
    if not pluginmanager.hasplugin("xdist"):
        for option in ("--numprocesses", "--dist"):
            parser.addoption(option, help="ignored without pytest-xdist")


@pytest.fixture(autouse=True)
def same_start() -> Iterator[None]:
    """Starts every test with the same random stream of torch."""
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)
    with same_process():
        yield


@contextlib.contextmanager
def same_process() -> Iterator[None]:
    """Restores a command's changes of its process: environment, logging, torch's threads."""
    environ, root = dict(os.environ), logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(environ)
        root.handlers[:] = handlers
        root.setLevel(level)
        if torch := sys.modules.get("torch"):
            torch.set_num_threads(1)


@pytest.fixture
def make() -> Iterator[Callable[..., polypod.VectorEnv]]:
    """`polypod.make` with small defaults, `robots=None` for all of the task.

    The envs are closed afterwards.
    """
    envs = []

    def build(num_envs: int = 16, seed: int = 1, **arguments: Any) -> polypod.VectorEnv:
        env = polypod.make(TASK, num_envs=num_envs, seed=seed, **{"robots": ROBOTS, **arguments})
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
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Finished]:
    """Runs `polypod` with arguments in this process, in a temporary directory or in `cwd`.

    It saves the seconds that a new process takes to import torch. `cli_process` starts a process.
    """

    def run(*arguments: str, cwd: Path = tmp_path) -> Finished:
        capsys.readouterr()
        with same_process(), monkeypatch.context() as patch:
            patch.chdir(cwd)
            patch.setattr(sys, "argv", ["polypod", *arguments])
            try:
                code = polypod.__main__.main()
            except SystemExit as left:
                code = left.code
        assert code is None or isinstance(code, int), code
        return subprocess.CompletedProcess(sys.argv, code or 0, *capsys.readouterr())

    return run


@pytest.fixture
def cli_process(tmp_path: Path) -> Callable[..., Finished]:
    """Runs `polypod` as `cli` does, in a separate process."""

    def run(*arguments: str, cwd: Path = tmp_path) -> Finished:
        command = [sys.executable, "-m", "polypod", *arguments]
        return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=170, check=False)

    return run


@pytest.fixture(scope="session")
def fork_server() -> Iterator[Any]:
    """Runs `polypod` in separate processes, each begun in milliseconds."""
    if not hasattr(os, "fork"):
        pytest.skip("processes are not forked here")
    from fork_server import ForkServer

    server = ForkServer()
    yield server
    server.close()


@pytest.fixture(scope="session")
def built_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Returns a folder that the first worker to ask for it fills and that all workers read."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent

    def folder(name: str, fill: Callable[[Path], object]) -> Path:
        done = base / f"{name}.done"
        with FileLock(base / f"{name}.lock"):
            if not done.exists():
                (base / name).mkdir(exist_ok=True)
                fill(base / name)
                done.touch()
        return base / name

    return folder


@pytest.fixture(scope="session")
def trained_run(built_once: Callable[..., Path]) -> Path:
    """The checkpoint of a training of one iteration with the options `common.TINY`."""
    from polypod.runs import run_dir
    from polypod.training import session

    def train(folder: Path) -> None:
        options = session.Options(log_dir=folder, device="cpu", logger="none", max_iterations=1, **TINY)
        with same_process():
            assert session.train(options) == 0

    return run_dir.find_checkpoint(built_once("trained_run", train), "latest")


@pytest.fixture(scope="session")
def exported_policy(built_once: Callable[..., Path]) -> tuple[Path, Any]:
    """The folder of the flat policy's export, and `export_checkpoint`'s result.

    A graph per robot is included.
    """
    from polypod.export import export_checkpoint

    def export(folder: Path) -> None:
        done = export_checkpoint(FLAT_POLICY, folder / "policy", fold=True)
        (folder / "done.pickle").write_bytes(pickle.dumps(done))

    folder = built_once("exported_policy", export)
    return folder / "policy", pickle.loads((folder / "done.pickle").read_bytes())


@pytest.fixture(scope="session")
def deployed_policies(built_once: Callable[..., Path]) -> Path:
    """The folder of `deployed.POLICIES`: a folder per bundled policy, with a graph per robot."""
    import deployed

    return built_once("deployed_policies", deployed.fill)


@pytest.fixture(scope="session")
def robot_loop() -> Any:
    """`examples/deploy/robot_loop.py` as a module."""
    path = ROOT / "examples" / "deploy" / "robot_loop.py"
    spec = spec_from_file_location("robot_loop", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["robot_loop"] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def cpp_loop(built_once: Callable[..., Path], exported_policy: tuple[Path, Any]) -> Path | None:
    """The program of `examples/deploy/policy_loop.cpp` for spot.

    None without a compiler or onnxruntime's headers.
    """
    compiler, runtime = shutil.which("g++"), find_spec("onnxruntime")
    root = Path(os.environ.get("ONNXRUNTIME", "/usr/local"))
    folders = [root / "include", root / "include" / "onnxruntime", Path("/usr/include/onnxruntime")]
    include = next((folder for folder in folders if (folder / "onnxruntime_cxx_api.h").is_file()), None)
    if compiler is None or include is None or runtime is None or runtime.origin is None:
        return None
    # a release has the library; otherwise that of the Python package serves, whose interface is the
    # same
    libraries = [*root.glob("lib*/libonnxruntime.so*"), *Path(runtime.origin).parent.glob("capi/libonnxruntime.so*")]
    if not libraries:
        return None

    def build(folder: Path) -> None:
        from polypod.deploy import files

        files.write(exported_policy[0] / "policy_spot.onnx", folder)
        # the name that the library gives itself
        (folder / "libonnxruntime.so.1").symlink_to(libraries[0])
        source = ROOT / "examples" / "deploy" / "policy_loop.cpp"
        flags = [f"-I{folder}", f"-I{include}", str(folder / "libonnxruntime.so.1"), f"-Wl,-rpath,{folder}"]
        command = [compiler, "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", str(source), *flags]
        subprocess.run([*command, "-o", str(folder / "policy_loop")], check=True)

    return built_once("policy_loop", build) / "policy_loop"
