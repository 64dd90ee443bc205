"""`make train` saves a checkpoint when make alone or all its processes are told to end."""

import os
import shutil
import signal
import subprocess

import pytest

from common import ROOT, size
from polypod.runs import run_dir
from same_bits import equal

# goals that change towards the end of a run would tell a long run from a short one
ARGS = "--num-envs 64 --robots spot --seed 5 --logger none --set sim.episode_length_s=1.0 --set train.anneal.start=1.0"


@pytest.mark.skipif(not shutil.which("make"), reason="there is no make here")
@pytest.mark.skipif(not (ROOT / ".venv/bin/polypod").exists(), reason="polypod is not built in .venv")
@pytest.mark.parametrize(
    ("to_all", "name"),
    size([(True, "SIGTERM")], [(True, "SIGTERM"), (False, "SIGTERM"), (True, "SIGHUP"), (True, "SIGINT")]),
)
def test_make_train(fork_server, tmp_path, to_all, name):
    # existing builds are not built again
    command = ["make", "-o", ".venv/.extension", "train", f"ARGS={ARGS} --max-iterations 100000 --log-dir {tmp_path}"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    environment |= {"UV_DEFAULT_INDEX": "none", "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    make = subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **pipes)
    said = []
    for line in make.stdout:
        said.append(line)
        if line.startswith("iteration"):
            break
    number = getattr(signal, name)
    if to_all:
        os.killpg(make.pid, number)
    else:
        make.send_signal(number)
    said.append(make.communicate(timeout=60)[0])
    assert make.returncode != 0
    with pytest.raises(ProcessLookupError):  # no training is left behind
        os.killpg(make.pid, 0)
    assert list(tmp_path.glob("rsl_rl/*/*/model_*.pt")), "".join(said)

    saved = run_dir.find_checkpoint(tmp_path, "latest")
    stopped = int(saved.stem.removeprefix("model_"))
    resume = ("train", "--logger", "none", "--resume", str(saved), "--max-iterations", "1")
    assert fork_server.run(*resume, cwd=tmp_path).code == 0
    whole = tmp_path / "whole"
    anew = ("train", "--train-config", "quick", *ARGS.split(), "--max-iterations", str(stopped + 1))
    assert fork_server.run(*anew, "--log-dir", str(whole), cwd=tmp_path).code == 0
    assert equal(saved.with_name(f"model_{stopped + 1}.pt"), run_dir.find_checkpoint(whole, "latest"))
