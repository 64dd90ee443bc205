"""A forked child that inherits a simulation ends without a word, and may build another."""

import os
import subprocess
import sys

import pytest

PARENT = """
import os, sys
import numpy as np
import polypod

def hash_of(env):
    return env.step(np.zeros(env.action_space.shape))[0].tobytes()

env = polypod.make("velocity_flat", num_envs={envs}, seed=1, threads={threads})
env.reset(seed=1)
child = os.fork()
if child == 0:
    {child}
_, status = os.waitpid(child, 0)
env.step(np.zeros(env.action_space.shape))
print(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.parametrize(
    ("child", "code"),
    [
        ("raise SystemExit(0)", 0),
        ("raise SystemExit(3)", 3),
        ("del env; raise SystemExit(0)", 0),
        ("env.close(); raise SystemExit(0)", 0),
        ("assert hash_of(polypod.make('velocity_flat', num_envs=8, seed=1)); raise SystemExit(0)", 0),
    ],
)
@pytest.mark.parametrize(("envs", "threads"), [(8, 1), (2048, 2)])
def test_a_child_ends_quietly(child, code, envs, threads):
    script = PARENT.format(envs=envs, threads=threads, child=child)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == f"{code}\n"
    assert "panicked" not in done.stderr
    assert "Exception" not in done.stderr
