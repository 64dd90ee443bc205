"""Commands that train and run policies start without torch's compiler.

`torch._dynamo` takes longer to import than torch, and polypod compiles nothing.
"""

import subprocess
import sys

import pytest

SCRIPT = """
import sys
from polypod.__main__ import main
code = main()
print(*(name for name in ("tensordict", "torch", "torch._dynamo") if name in sys.modules))
sys.exit(code)
"""
TRAIN = "train --train-config quick --robots unitree_a1 --num-envs 8 --max-iterations 1 --logger none"


@pytest.mark.parametrize("more", ["", "--learner rsl_rl --set train.run.symmetry=alternate"], ids=["native", "graphs"])
def test_the_learners_that_a_gpu_has_and_the_evaluation_need_no_compiler(tmp_path, more):
    """The native one, and that of CUDA graphs, which a CPU computes without them."""
    command = [sys.executable, "-c", SCRIPT, *TRAIN.split(), *more.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "tensordict torch"


def test_programs_that_import_polypod_keep_their_imports():
    """In a separate process: tests that run commands change the imports of theirs."""
    script = "import sys; before = list(sys.meta_path); import polypod.vector_env; print(sys.meta_path == before)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["True"], done.stderr
