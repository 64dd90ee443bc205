"""onnxruntime is imported in two places, which switch its telemetry off first.

One is for polypod, one for a robot.
"""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import polypod
from common import FLAT_POLICY, ROOT

PACKAGE = Path(polypod.__file__).parent
EXAMPLES = ROOT / "examples"
ONLY = PACKAGE / "networks" / "onnx_session.py"
ONBOARD = PACKAGE / "deploy" / "onboard" / "policy_loop.py"
GRAPH = FLAT_POLICY.parent / "exported" / "policy.onnx"


def imports(source):
    """Whether Python code imports onnxruntime: by a statement, or by its name in a call."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Call):
            names = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
        if any(isinstance(name, str) and re.fullmatch(r"onnxruntime(\..*)?", name) for name in names):
            return True
    return False


def test_nothing_else_imports_it():
    assert imports("import onnxruntime.capi as c")
    assert imports("from onnxruntime import InferenceSession")
    assert imports('package("onnxruntime", "x", "export")')
    assert [path for path in sorted(PACKAGE.rglob("*.py")) if imports(path.read_text(encoding="utf-8"))] == [
        ONBOARD,
        ONLY,
    ]


def test_examples_switch_it_off_first():
    for path in (ONBOARD, *EXAMPLES.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if imports(text):
            assert text.index("ORT_DISABLE_TELEMETRY") < text.index("import onnxruntime"), path


CODE = f"""
from polypod.export import OnnxPolicy
from polypod.networks.onnx_network import OnnxNetwork
OnnxPolicy({str(GRAPH)!r})
OnnxNetwork(open({str(GRAPH)!r}, "rb").read())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the files that are looked for are those of Linux")
def test_a_graph_that_is_loaded_leaves_no_id_behind(tmp_path):
    hidden = ("ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment["HOME"] = str(tmp_path)
    subprocess.run([sys.executable, "-c", CODE], env=environment, check=True, timeout=600)
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in str(path) or "Microsoft" in str(path)]
