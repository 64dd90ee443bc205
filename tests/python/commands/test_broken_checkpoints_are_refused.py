"""Broken checkpoints and graphs are refused in one line, before anything uses them."""

import contextlib
import io
import json
import math
import os
import resource
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

import polypod
from common import FLAT_POLICY
from polypod import files
from polypod.export import OnnxPolicy, checkpoint, onnx_graph
from polypod.networks.onnx_network import OnnxNetwork
from polypod.runs import run_dir

KEY = "mlp.0.weight"
TINY = ("--num-envs", "8", "--steps", "1")
COMMANDS = {
    "eval": ("eval", *TINY, "--checkpoint"),
    "play": ("play", "--headless", "--seconds", "0.1", "--checkpoint"),
    "export": ("export", "--formats", "onnx", "--checkpoint"),
    "sim2sim": ("sim2sim", "--num-envs", "1", "--steps", "1", "--checkpoint"),
    "resume": ("train", "--logger", "none", "--max-iterations", "1", "--resume"),
    "init": ("train", "--logger", "none", "--max-iterations", "1", "--num-envs", "64", "--init"),
}


def repeated(shape):
    """A tensor of four bytes that says it has this shape."""
    return torch.as_strided(torch.zeros(1), shape, (0,) * len(shape))


TENSORS = {
    "sparse": lambda like: like.to_sparse(),
    "compressed": lambda like: like.to_sparse_csr(),
    "repeated": lambda like: repeated((2**20, 2**20)),
    "repeated in shape": lambda like: repeated(tuple(like.shape)),
    "meta": lambda like: like.to("meta"),
    "complex": lambda like: like.to(torch.complex64),
    "quantized": lambda like: torch.quantize_per_tensor(like, 0.1, 0, torch.qint8),
    "whole numbers": lambda like: like.to(torch.int32),
    "eight bits": lambda like: like.to(torch.float8_e4m3fn),
    "empty": lambda like: like[:0],
    "flat": lambda like: like.flatten(),
    "too large": lambda like: like.double() + 1e39,
    "nan": lambda like: like * math.nan,
}


def broken(folder, change, name=FLAT_POLICY.name):
    """A checkpoint next to its manifest, with a changed state.

    Its sum is left out.
    """
    state = torch.load(FLAT_POLICY, weights_only=True)
    change(state)
    path = folder / "run" / name
    path.parent.mkdir(exist_ok=True)
    torch.save(state, path)
    manifest = json.loads((FLAT_POLICY.parent / "manifest.json").read_text())
    manifest.pop("checkpoints", None)
    (path.parent / "manifest.json").write_text(json.dumps(manifest))
    return path


def refused(done):
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.parametrize("kind", TENSORS)
def test_a_tensor_that_is_no_array_of_weights(kind, cli, tmp_path):
    def change(state):
        weights = state["actor_state_dict"]
        weights[KEY] = TENSORS[kind](weights[KEY])

    path = broken(tmp_path, change)
    message = refused(cli(*COMMANDS["eval"], str(path)))
    assert "size mismatch" in message or KEY in message


@pytest.mark.filterwarnings("ignore:.*nested tensors.*")
def test_a_nested_tensor_is_refused_before_its_shape_is_read():
    """It has none. torch 2.11 reads one as weights, torch 2.15 does not."""
    nested = torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)])
    with pytest.raises(polypod.ConfigError, match="a kind that no checkpoint holds"):
        run_dir._check_plain(nested, KEY)


@pytest.mark.filterwarnings("error")  # a warning is a line more
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("kind", ["sparse", "repeated"])
def test_every_command_refuses_it(kind, command, cli, tmp_path):
    path = broken(tmp_path, lambda state: state["actor_state_dict"].update({KEY: TENSORS[kind](torch.ones(4, 4))}))
    assert KEY in refused(cli(*COMMANDS[command], str(path)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(critic_state_dict=[1, 2]), "critic_state_dict is not a network's state"),
        (
            lambda state: state.update(critic_state_dict={1: torch.ones(2)}),
            "critic_state_dict is not a network's state",
        ),
        (lambda state: state["actor_state_dict"].update(mlp=3), "actor_state_dict mlp holds no weights"),
        (lambda state: state.update(iter=torch.ones(2)), "iter is not a number of iterations"),
        (lambda state: state.update(iter=-1), "iter is not a number of iterations"),
        (lambda state: state.update(infos={"sim": [repeated((2**20, 2**20))]}), "infos sim 0 has the shape"),
        (lambda state: state["actor_state_dict"].update({"obs_normalizer._var": -torch.ones(1, 83)}), "below 0"),
    ],
)
def test_a_state_that_is_no_checkpoint(change, message, tmp_path):
    path = broken(tmp_path, change)
    with pytest.raises(polypod.ConfigError, match=message):
        run_dir.load_checkpoint(path)


def test_a_state_that_holds_itself_is_read_once(tmp_path):
    def change(state):
        state["infos"] = {"own": []}
        state["infos"]["own"].append(state["infos"])

    assert run_dir.load_checkpoint(broken(tmp_path, change))["infos"]["own"]


@pytest.mark.parametrize(("key", "value"), [("seed", 2**64), ("seed", 10**400), ("num_envs", 2**70)])
def test_numbers_of_a_manifest_have_bounds(key, value, cli, tmp_path):
    path = broken(tmp_path, lambda state: None)
    manifest = json.loads((path.parent / "manifest.json").read_text())
    (path.parent / "manifest.json").write_text(json.dumps({**manifest, key: value}))
    for command in ("eval", "resume"):
        assert key in refused(cli(*COMMANDS[command], str(path)))


def graph(nodes, outputs=(12,), inputs=48, initializers=(), opset=17, name="actions"):
    value = helper.make_tensor_value_info
    ends = [value("obs", TensorProto.FLOAT, ["batch", inputs])]
    found = [value(name, TensorProto.FLOAT, ["batch", size]) for size in outputs]
    made = helper.make_graph(nodes, "policy", ends, found, list(initializers))
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def matrix(scale=0.0):
    return onnx.numpy_helper.from_array(np.full((48, 12), scale, dtype=np.float32), "weights")


PRODUCT = helper.make_node("MatMul", ["obs", "weights"], ["actions"])


def external(location):
    tensor = matrix()
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", location
    return tensor


def in_a_branch():
    """External data in a constant of a subgraph."""
    inner = helper.make_node("Constant", [], ["inner"], value=external("weights.bin"))
    branch = helper.make_graph([inner], "branch", [], [helper.make_tensor_value_info("inner", 1, [48, 12])])
    sure = helper.make_node("Constant", [], ["sure"], value=helper.make_tensor("t", TensorProto.BOOL, [], [True]))
    chosen = helper.make_node("If", ["sure"], ["weights"], then_branch=branch, else_branch=branch)
    return graph([sure, chosen, PRODUCT])


NO_OUTPUT = graph([PRODUCT], outputs=(), initializers=[matrix()])
HUGE = helper.make_node("Expand", ["obs", "size"], ["actions"])
SIZE = onnx.numpy_helper.from_array(np.array([1 << 40, 1 << 20], dtype=np.int64), "size")
GRAPHS = {
    "no output": (NO_OUTPUT, "has no output"),
    "external": (graph([PRODUCT], initializers=[external("weights.bin")]), "keeps weights in another file"),
    "external, absolute": (graph([PRODUCT], initializers=[external("/etc/passwd")]), "keeps weights in another file"),
    "external in a branch": (in_a_branch(), "keeps weights in another file"),
    "opset": (graph([PRODUCT], initializers=[matrix()], opset=9999), "is not loaded by onnxruntime"),
    "huge": (graph([HUGE], initializers=[SIZE]), "onnxruntime"),
    "nan": (graph([PRODUCT], initializers=[matrix(math.nan)]), "the action of env 0 for LF_HAA is NaN"),
    "large": (graph([PRODUCT], initializers=[matrix(1e38)]), "the action of env 0 for LF_HAA is"),
    "wide": (graph([PRODUCT], outputs=(2**40,), initializers=[matrix()]), "onnx"),
}


@pytest.mark.parametrize("command", ["eval", "play"])
@pytest.mark.parametrize("kind", GRAPHS)
def test_graphs(kind, command, cli, tmp_path):
    model, message = GRAPHS[kind]
    path = tmp_path / "policy.onnx"
    path.write_bytes(model.SerializeToString())
    # where onnxruntime would look for it
    (tmp_path / "weights.bin").write_bytes(bytes(4 * 48 * 12))
    done = cli(*COMMANDS[command][:-1], "--task", "Velocity-Flat-Spot-v0", "--checkpoint", str(path))
    assert message in refused(done)


def test_a_graph_with_branches_is_exported():
    """Their nodes use tensors of the graph around them, whose names an export changes."""
    inner = helper.make_node("MatMul", ["obs", "weights"], ["product"])
    branch = helper.make_graph([inner], "branch", [], [helper.make_tensor_value_info("product", 1, ["batch", 12])])
    sure = helper.make_node("Constant", [], ["sure"], value=helper.make_tensor("t", TensorProto.BOOL, [], [True]))
    chosen = helper.make_node("If", ["sure"], ["actions"], then_branch=branch, else_branch=branch)
    network = OnnxNetwork(graph([sure, chosen], initializers=[matrix(0.01)]).SerializeToString())
    made = onnx_graph.network_model(network, 48, 12, {}).SerializeToString()
    assert checkpoint.compare(OnnxPolicy(made), network, {"obs": 48}, ["actions"]) < 1e-6


def test_a_sound_graph_is_taken(cli, tmp_path):
    """The only fault of the other graphs is their own."""
    path = tmp_path / "policy.onnx"
    path.write_bytes(graph([PRODUCT], initializers=[matrix(0.001)]).SerializeToString())
    done = cli("eval", *TINY, "--task", "Velocity-Flat-Spot-v0", "--checkpoint", str(path))
    assert done.returncode == 0, done.stderr


def test_a_small_checkpoint_takes_little_memory(tmp_path):
    """Under a limit of the address space, as batch systems set it."""
    code = (
        "from pathlib import Path; from polypod import files;"
        "import resource; now = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize();"
        "resource.setrlimit(resource.RLIMIT_AS, (now + (64 << 20),) * 2);"
        f"assert len(files.read_bytes(Path({str(FLAT_POLICY)!r}), 4 << 30)) == {FLAT_POLICY.stat().st_size}"
    )
    if not Path("/proc/self/statm").is_file() or not hasattr(resource, "RLIMIT_AS"):
        pytest.skip("needs Linux")
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


@pytest.mark.parametrize("size", [0, 1, 5, files._PIECE, 2 * files._PIECE + 7])
def test_files_are_read_whole(size, tmp_path):
    path = tmp_path / "data"
    path.write_bytes(bytes(size))
    assert len(files.read_bytes(path, 1 << 40)) == size
    assert len(files.read_bytes(path, size)) == size
    if size:
        with pytest.raises(polypod.ConfigError, match="too many"):
            files.read_bytes(path, size - 1)


def test_pipes_and_files_that_grow_have_bounds(tmp_path, monkeypatch):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    data = bytes(3 * files._PIECE + 11)
    for limit, fits in ((len(data), True), (len(data) - 1, False)):
        writer = threading.Thread(target=_written, args=(pipe, data))
        writer.start()
        if fits:
            assert files.read_bytes(pipe, limit) == data
        else:
            with pytest.raises(polypod.ConfigError, match="too many"):
                files.read_bytes(pipe, limit)
        writer.join()

    class Growing(io.BytesIO):
        def fileno(self):
            return small.fileno()

    path = tmp_path / "small"
    path.write_bytes(b"x")
    with path.open("rb") as small:
        monkeypatch.setattr(Path, "open", lambda *_: Growing(data))
        assert files.read_bytes(path, len(data)) == data
        with pytest.raises(polypod.ConfigError, match="too many"):
            files.read_bytes(path, len(data) - 1)


def _written(pipe, data):
    with contextlib.suppress(BrokenPipeError):
        pipe.write_bytes(data)
