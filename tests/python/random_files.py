"""Random hostile files: sound ones of every kind that polypod reads, changed where it hurts.

`case` writes the files of one draw into a folder and says which commands read them.
"""

import dataclasses
import hashlib
import io
import json
import pickle
import random
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from common import FLAT_POLICY
from polypod.compat import tomllib
from random_input import ROOT, anything, changed, generator, integer, mutated, number, toml_file, word

ROBOTS = ["box_quadruped", "spot", "cassie", "solo12", "unitree_go2w", "berkeley_humanoid", "phantomx"]
URDFS = [ROOT / "assets" / "robots" / name / "robot.urdf" for name in ROBOTS]
URDFS += sorted((ROOT / "tests" / "data" / "urdf").glob("*.urdf"))
URDFS += sorted((ROOT / "tests" / "data" / "bodies" / "assets").glob("*.urdf"))
MESHES = sorted((ROOT / "tests" / "data" / "urdf" / "meshes").glob("cube*"))
EXPORT = FLAT_POLICY.parent / "exported"


@dataclasses.dataclass
class Case:
    """Command that reads the files of a draw."""

    commands: list[tuple[str, list[str]]]
    """Programs and words."""
    task: dict[str, Any] | None = None
    """Task, robots and overrides to step if the first command takes the files."""
    urdf: str | None = None
    """URDF to step without a task if the last command takes the files."""
    call: dict[str, Any] | None = None
    """Arguments of `reads_snapshots`, in place of commands."""


def bytes_changed(draw: random.Random, data: bytes, times: int = 0) -> bytes:
    """Bytes with some flipped, cut, repeated, removed or put in."""
    new = bytearray(data)
    for _ in range(times or draw.choice((1, 1, 2, 5, 20))):
        if not new:
            break
        at = draw.randrange(len(new))
        size = draw.choice((1, 2, 4, 8, 64, 1000))
        kind = draw.randrange(7)
        if kind == 0:
            new[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            new[at : at + size] = draw.randbytes(size)
        elif kind == 2:
            del new[at : at + size]
        elif kind == 3:
            new[at:at] = new[at : at + size]
        elif kind == 4:
            del new[at:]
        elif kind == 5:
            new[at : at + 4] = struct.pack("<f", _single(draw))
        else:
            new[at : at + 4] = draw.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80"))
    return bytes(new)


def _single(draw: random.Random) -> float:
    value = number(draw)
    return value if abs(value) < 3e38 or value != value else draw.choice((float("inf"), 3.4e38, -3.4e38))


def text_changed(draw: random.Random, text: str) -> bytes:
    """A text that is cut, in another encoding, or has lines twice, swapped, or of another kind."""
    kind = draw.randrange(8)
    lines = text.splitlines(keepends=True)
    at, other = draw.randrange(len(lines)), draw.randrange(len(lines))
    if kind == 0:
        return text[: draw.randrange(len(text))].encode()
    if kind == 1:
        return text.encode(draw.choice(("utf-16", "utf-32", "utf-8-sig", "utf-16-le")))
    if kind == 2:
        lines.insert(at, lines[other])
    elif kind == 3:
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 4:
        lines[at] = word(draw) + lines[at]
    elif kind == 5:
        lines[at] = lines[at].replace("0", draw.choice(("1e999", "nan", "-", "0x0", "\u0660")), 1)
    elif kind == 6:
        del lines[at:other]
    else:
        return bytes_changed(draw, text.encode(), 1)
    return "".join(lines).encode(errors="replace")


# --- URDF


def _numbers(draw: random.Random, text: str) -> str:
    words = text.split()
    for _ in range(draw.choice((1, 1, 3))):
        if not words:
            return repr(number(draw))
        at = draw.randrange(len(words))
        try:
            near = float(words[at])
        except ValueError:
            words[at] = word(draw)
        else:
            words[at] = draw.choice(
                [repr(number(draw, near)), repr(number(draw, near)), word(draw), f"${{{words[at]}}}"]
            )
    if draw.random() < 0.1:
        words = draw.choice([words[:-1], [*words, "1"], words * 50])
    return " ".join(words)


def urdf_changed(draw: random.Random, text: str) -> bytes:
    """A URDF with elements doubled, removed, renamed or moved, and other values."""
    root = ElementTree.fromstring(text)
    for _ in range(draw.choice((1, 1, 1, 1, 2, 4))):
        everything = list(root.iter())
        parents = [element for element in everything if len(element)]
        element, parent = draw.choice(everything), draw.choice(parents)
        child = draw.choice(list(parent))
        kind = draw.randrange(14)
        if kind in (0, 1, 2) and element.attrib:
            name = draw.choice(list(element.attrib))
            element.set(name, _numbers(draw, element.get(name, "")))
        elif kind == 3:
            parent.insert(draw.randrange(len(parent) + 1), child)
        elif kind == 4:
            parent.remove(child)
        elif kind == 5:
            element.tag = draw.choice([draw.choice(everything).tag, "xacro:" + element.tag, element.tag + "s"])
        elif kind == 6 and element.attrib:
            del element.attrib[draw.choice(list(element.attrib))]
        elif kind == 7:
            place = draw.choice(parents)
            # within itself it would make a circle, which no text can hold
            if place not in child.iter():
                place.append(child)
        elif kind == 8:
            links = [link.get("name", "") for link in root.iter("link")] or [""]
            for end in draw.sample(["parent", "child"], draw.choice((1, 2))):
                ends = list(root.iter(end))
                if ends:
                    draw.choice(ends).set("link", draw.choice(links))
        elif kind == 9:
            named = [one for one in everything if "name" in one.attrib]
            if named:
                new = draw.choice([word(draw), draw.choice(named).get("name", ""), "\u0391\u0301" * 40])
                draw.choice(named).set("name", "".join(c for c in new if c.isprintable()))
        elif kind == 10:
            joints = list(root.iter("joint"))
            if joints:
                types = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical", ""]
                draw.choice(joints).set("type", draw.choice(types))
        elif kind == 11:
            extra = draw.choice(("mimic", "limit", "dynamics", "axis", "origin", "inertial", "mass", "mesh", "sphere"))
            values = {name: _numbers(draw, "0 0 1") for name in draw.sample(_ATTRIBUTES, 3)}
            element.append(ElementTree.Element(extra, values))
        elif kind == 12:
            scale = number(draw)
            for one in root.iter(draw.choice(("mass", "inertia", "limit", "origin", "box", "cylinder", "sphere"))):
                for name, value in one.attrib.items():
                    one.set(name, " ".join(_scaled(part, scale) for part in value.split()))
        else:
            named = [joint.get("name", "") for joint in root.iter("joint")]
            if named:
                mimic = ElementTree.Element("mimic", {"joint": draw.choice(named), "multiplier": repr(number(draw))})
                draw.choice(list(root.iter("joint"))).append(mimic)
    try:
        new = ElementTree.tostring(root, encoding="unicode")
    except (TypeError, ValueError):
        return text_changed(draw, text)
    if draw.random() < 0.1:
        leftover = '<xacro:property name="a" value="1"/><xacro:if value="${a}">'
        new = new.replace("<link", draw.choice((leftover, "<!--", "<![CDATA[", "<?x?>", "&lt;")) + "<link", 1)
    return text_changed(draw, new) if draw.random() < 0.1 else new.encode(errors="replace")


_ATTRIBUTES = ["joint", "lower", "upper", "effort", "velocity", "damping", "friction", "xyz", "rpy", "value", "radius"]
_ATTRIBUTES += ["filename", "scale", "multiplier", "offset"]


def _scaled(part: str, scale: float) -> str:
    try:
        return repr(float(part) * scale)
    except ValueError:
        return part


def _urdf(draw: random.Random, folder: Path) -> Case:
    source = draw.choice(URDFS)
    (folder / "robot.urdf").write_bytes(urdf_changed(draw, source.read_text(encoding="utf-8")))
    if (source.parent / "meshes").is_dir():
        shutil.copytree(source.parent / "meshes", folder / "meshes")
    new = ["robot", "new", "robot.urdf", "--out", "new.toml"]
    commands = [("polypod", new), ("polypod-sim", ["check", "robot.urdf"])]
    return Case(commands, {"task": "velocity_flat_legged", "robots": ["new.toml"], "overrides": []}, urdf="robot.urdf")


_MESHED = """<robot name="meshed"><link name="base"><inertial><mass value="5"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{name}" scale="{scale}"/></geometry></collision></link></robot>
"""


def _mesh(draw: random.Random, folder: Path) -> Case:
    source = draw.choice(MESHES)
    data = source.read_bytes()
    binary = source.name == "cube.stl"
    if binary and draw.random() < 0.3:
        count = integer(draw, 12) % 2**32
        data = data[:80] + struct.pack("<I", count) + data[84:] * draw.choice((0, 1, 3))
    elif not binary and draw.random() < 0.7:
        words = data.decode().split(" ")
        for _ in range(draw.choice((1, 3, 10))):
            at = draw.randrange(len(words))
            words[at] = draw.choice(
                [repr(number(draw)), str(integer(draw)), word(draw), words[draw.randrange(len(words))]]
            )
        data = " ".join(words).encode(errors="replace")
    else:
        data = bytes_changed(draw, data)
    suffix = source.suffix if draw.random() < 0.9 else draw.choice((".STL", ".obj", ".dae", ".ply", ""))
    (folder / f"mesh{suffix}").write_bytes(data)
    scale = " ".join(repr(number(draw)) for _ in range(3)) if draw.random() < 0.3 else "1 1 1"
    (folder / "robot.urdf").write_text(_MESHED.format(name=f"mesh{suffix}", scale=scale))
    commands = [("polypod-sim", ["check", "robot.urdf"]), ("polypod", ["check", "robot.urdf"])]
    return Case(commands, urdf="robot.urdf")


# --- TOML


def _robot_config(draw: random.Random, folder: Path) -> Case:
    name = draw.choice(ROBOTS)
    tables = tomllib.loads((ROOT / "configs" / "robots" / f"{name}.toml").read_text(encoding="utf-8"))
    tables["urdf"] = str(ROOT / "assets" / "robots" / name / "robot.urdf")
    text = toml_file(mutated(draw, {**tables, "name": "mine"}, draw.choice((1, 1, 2, 4))))
    (folder / "mine.toml").write_bytes(
        text_changed(draw, text) if draw.random() < 0.1 else text.encode(errors="replace")
    )
    task = "velocity_flat_legged"
    line = ["rollout", "--task", task, "--robots", "mine.toml", "--num-envs", "8", "--steps", "2"]
    return Case([("polypod-sim", line)], {"task": task, "robots": ["mine.toml"], "overrides": []})


def _task_config(draw: random.Random, folder: Path) -> Case:
    name = draw.choice(["velocity_flat", "velocity_obstacles", "velocity_rough", "velocity_flat_variation"])
    tables = tomllib.loads((ROOT / "configs" / "tasks" / f"{name}.toml").read_text(encoding="utf-8"))
    tables |= {"name": "Mine-v0", "aliases": []}
    if name == "velocity_rough":
        terrain = tables.setdefault("scene", {}).setdefault("terrain", {})
        terrain |= {"num_rows": 2, "num_cols": 10, "border_width": 2.0}
    text = toml_file(mutated(draw, tables, draw.choice((1, 1, 2, 4))))
    (folder / "mine.toml").write_bytes(
        text_changed(draw, text) if draw.random() < 0.1 else text.encode(errors="replace")
    )
    line = ["rollout", "--task", "mine.toml", "--robots", "spot", "--num-envs", "8", "--steps", "2"]
    return Case([("polypod-sim", line)], {"task": "mine.toml", "robots": ["spot"], "overrides": []})


def _heightfield(draw: random.Random, folder: Path) -> Case:
    """An obstacle of random heights; most are near what a robot walks on."""
    rows, columns = draw.choice(((2, 2), (3, 5), (1, 4), (0, 0), (40, 40), (2, 300)))
    heights: Any = [[number(draw, 0.05) if draw.random() < 0.02 else draw.uniform(-0.1, 0.1) for _ in range(columns)]]
    heights = [list(heights[0]) for _ in range(rows)]
    if draw.random() < 0.2:
        heights = changed(draw, heights)
    obstacle: dict[str, Any] = {"shape": "heightfield", "size": [2.0, 2.0], "position": [1.0, 0.0, 0.0]}
    obstacle = mutated(draw, {**obstacle, "heights": heights}, draw.choice((0, 1, 1, 2)))
    others = [
        {
            "shape": shape,
            "size": [number(draw, 1.0) for _ in range(3)],
            "position": [number(draw, 1.0) for _ in range(3)],
        }
        for shape in draw.sample(["box", "ramp", "stairs", "sphere", "cylinder", "capsule"], draw.choice((0, 0, 1)))
    ]
    base = {"extends": "velocity_flat", "name": "Mine-v0", "scene": {"obstacles": [obstacle, *others]}}
    (folder / "mine.toml").write_text(toml_file(base), encoding="utf-8", errors="replace")
    line = ["rollout", "--task", "mine.toml", "--robots", "unitree_a1", "--num-envs", "8", "--steps", "2"]
    return Case([("polypod-sim", line)], {"task": "mine.toml", "robots": ["unitree_a1"], "overrides": []})


def _train_config(draw: random.Random, folder: Path) -> Case:
    name = draw.choice(["flat", "flat_universal", "flat_joints", "legged_masked", "quick"])
    tables = tomllib.loads((ROOT / "configs" / "train" / f"{name}.toml").read_text(encoding="utf-8"))
    text = toml_file(mutated(draw, tables, draw.choice((1, 2, 4))))
    (folder / "mine.toml").write_bytes(
        text_changed(draw, text) if draw.random() < 0.1 else text.encode(errors="replace")
    )
    size = ["--num-envs", "16", "--max-iterations", "1", "--robots", "spot", "--task", "velocity_flat"]
    return Case([("polypod", ["train", "--train-config", "mine.toml", "--logger", "none", *size])])


def _sweep(draw: random.Random, folder: Path) -> Case:
    train = {"num_envs": 16, "max_iterations": 1, "set": ["sim.episode_length_s=0.4"], "device": "cpu", "threads": 1}
    tables = {
        "seeds": [1],
        "train": train,
        "configs": {"plain": {"train_config": "quick"}},
        "robots": {"one": ["spot"]},
    }
    text = toml_file(mutated(draw, tables, draw.choice((1, 2, 3))))
    (folder / "mine.toml").write_bytes(
        text_changed(draw, text) if draw.random() < 0.2 else text.encode(errors="replace")
    )
    return Case([("polypod", ["sweep", "mine.toml", "--out", "out"])])


# --- policies


_TINY = ["--num-envs", "8", "--steps", "2", "--robots", "spot"]


def _manifest(draw: random.Random, folder: Path) -> Case:
    tables = mutated(draw, json.loads((FLAT_POLICY.parent / "manifest.json").read_text()), draw.choice((1, 1, 3)))
    text = json.dumps(tables)
    (folder / "manifest.json").write_bytes(text_changed(draw, text) if draw.random() < 0.15 else text.encode())
    shutil.copy(FLAT_POLICY, folder)
    command = draw.choice([["eval", *_TINY], ["export", "--formats", "onnx", "--out", "out"]])
    return Case([("polypod", [*command, "--checkpoint", FLAT_POLICY.name])])


def _exported_manifest(draw: random.Random, folder: Path) -> Case:
    tables = mutated(draw, json.loads((EXPORT / "policy.json").read_text()), draw.choice((1, 1, 3)))
    text = json.dumps(tables)
    (folder / "policy.json").write_bytes(text_changed(draw, text) if draw.random() < 0.15 else text.encode())
    shutil.copy(EXPORT / "policy.onnx", folder)
    sim = ["play", "--policy", "policy.onnx", *_TINY]
    python = ["eval", "--checkpoint", "policy.onnx", "--task", "velocity_flat_universal", *_TINY]
    return Case([draw.choice([("polypod-sim", sim), ("polypod-sim", sim), ("polypod", python)])])


def _signed(folder: Path, graph: bytes) -> None:
    """Writes a graph and a manifest that has its sum, so that the graph itself is read."""
    (folder / "policy.onnx").write_bytes(graph)
    tables = json.loads((EXPORT / "policy.json").read_text())
    tables["files"]["policy.onnx"] = hashlib.sha256(graph).hexdigest()
    (folder / "policy.json").write_text(json.dumps(tables))


def graph_changed(draw: random.Random) -> bytes:
    """The exported graph with other nodes, tensors, shapes, types or bytes."""
    import onnx

    data = (EXPORT / "policy.onnx").read_bytes()
    if draw.random() < 0.35:
        return bytes_changed(draw, data)
    model = onnx.ModelProto.FromString(data)
    graph = model.graph
    for _ in range(draw.choice((1, 1, 2, 3))):
        kind, node = draw.randrange(15), draw.choice(graph.node)
        tensor = draw.choice(graph.initializer)
        if kind == 0:
            del graph.output[:]
        elif kind == 1:
            del graph.input[:]
        elif kind == 2:
            node.op_type = draw.choice(
                ["Add", "Loop", "If", "Expand", "Tile", "Resize", "Gather", "Conv", "Nope", "", "Exp"]
            )
        elif kind == 3:
            graph.node.append(node)
        elif kind == 4:
            graph.node.remove(node)
        elif kind == 5 and node.input:
            node.input[draw.randrange(len(node.input))] = draw.choice([*node.output, *graph.node[-1].output, "", "x"])
        elif kind == 6 and tensor.dims:
            tensor.dims[draw.randrange(len(tensor.dims))] = draw.choice([0, -1, 1, 2**31, 2**62, -(2**63)])
        elif kind == 7:
            tensor.data_type = draw.randint(-1, 24)
        elif kind == 8:
            tensor.raw_data = bytes_changed(draw, tensor.raw_data) if tensor.raw_data else draw.randbytes(8)
        elif kind == 9:
            tensor.ClearField("raw_data")
            tensor.data_location = onnx.TensorProto.EXTERNAL
            for key, value in (("location", draw.choice(["w.bin", "/etc/passwd", "../w.bin", ""])), ("offset", "-1")):
                entry = tensor.external_data.add()
                entry.key, entry.value = key, value
        elif kind == 10:
            values = draw.choice([graph.input, graph.output])
            if values and values[0].type.tensor_type.shape.dim:
                dim = draw.choice(values[0].type.tensor_type.shape.dim)
                dim.dim_value = draw.choice([0, -1, 1, 84, 2**40])
        elif kind == 11:
            values = draw.choice([graph.input, graph.output])
            if values:
                values[0].type.tensor_type.elem_type = draw.randint(-1, 24)
        elif kind == 12:
            values = draw.choice([graph.input, graph.output])
            if values:
                values.append(values[0])
                values[-1].name = draw.choice([values[0].name, word(draw), "extra"])
        elif kind == 13:
            for version in model.opset_import:
                version.version = draw.choice([0, -1, 1, 5, 99, 2**40])
        else:
            weights = [number(draw) for _ in range(max(1, len(tensor.raw_data) // 4))]
            packed = [value if abs(value) < 3e38 else 3e38 for value in weights]
            tensor.raw_data = struct.pack(f"<{len(packed)}f", *packed)
    return model.SerializeToString()


def _graph(draw: random.Random, folder: Path) -> Case:
    _signed(folder, graph_changed(draw))
    sim = ("polypod-sim", ["play", "--policy", "policy.onnx", *_TINY])
    python = ["eval", "--checkpoint", "policy.onnx", "--task", "velocity_flat_universal", *_TINY]
    return Case([sim, ("polypod", python)])


@cache
def _checkpoint_tables() -> bytes:
    import torch

    return pickle.dumps(torch.load(FLAT_POLICY, map_location="cpu", weights_only=True))


def _tensor(draw: random.Random, tensor: Any) -> Any:
    """Another tensor in the place of one."""
    import torch

    kind = draw.randrange(14)
    if kind == 0:
        return tensor.to_sparse()
    if kind == 1:
        return torch.as_strided(torch.zeros(1), (draw.choice((2**15, 2**20)), 2**20), (0, 0))
    if kind == 2:
        return torch.full_like(tensor, draw.choice((float("nan"), float("inf"), 3e38, -3e38, 1e-45)))
    if kind == 3:
        return tensor.to(draw.choice((torch.float64, torch.float16, torch.int64, torch.bool, torch.complex64)))
    if kind == 4:
        return tensor.reshape(-1)
    if kind == 5:
        return tensor.T if tensor.dim() == 2 else tensor[None]
    if kind == 6:
        return tensor[..., :-1] if tensor.dim() else tensor[None]
    if kind == 7:
        return torch.empty(0)
    if kind == 8:
        return torch.empty(tensor.shape, device="meta")
    if kind == 9:
        return torch.zeros([1] * draw.choice((30, 64)))
    if kind == 10:
        return torch.quantize_per_tensor(tensor.float(), 0.1, 0, torch.qint8)
    if kind == 11:
        return tensor.clone().requires_grad_() if tensor.is_floating_point() else tensor
    if kind == 12:
        return torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)])
    return anything(draw)


def _edit_tensors(draw: random.Random, tables: Any) -> None:
    while isinstance(tables, dict) and tables:
        key = draw.choice(list(tables))
        value = tables[key]
        if isinstance(value, dict) and value and draw.random() < 0.9:
            tables = value
            continue
        kind = draw.random()
        if kind < 0.7 and hasattr(value, "dim"):
            tables[key] = _tensor(draw, value)
        elif kind < 0.8:
            del tables[key]
        elif kind < 0.9:
            tables[draw.choice([key, f"{key}x", 3, None])] = value
        else:
            tables[key] = anything(draw)
        return


class _Runs:
    """A pickle that would write a file, were it read by Python."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return open, ("PWNED", "w")


def _checkpoint(draw: random.Random, folder: Path) -> Case:
    import torch

    path = folder / "model_1.pt"
    kind = draw.random()
    if kind < 0.55:
        tables = pickle.loads(_checkpoint_tables())
        for _ in range(draw.choice((1, 1, 2, 4))):
            _edit_tensors(draw, tables)
        torch.save(tables, path)
    elif kind < 0.8:
        into = io.BytesIO()
        with zipfile.ZipFile(FLAT_POLICY) as source, zipfile.ZipFile(into, "w") as target:
            names = source.namelist()
            hit = draw.choice(names)
            for name in names:
                data = source.read(name)
                if name == hit:
                    if draw.random() < 0.2:
                        continue
                    data = bytes_changed(draw, data)
                    name = name if draw.random() < 0.8 else draw.choice(["../x", "/x", name + "x", names[0]])
                target.writestr(name, data)
        path.write_bytes(into.getvalue())
    elif kind < 0.95:
        path.write_bytes(bytes_changed(draw, FLAT_POLICY.read_bytes()))
    else:
        path.write_bytes(
            draw.choice([pickle.dumps(_Runs()), pickle.dumps({"a": 1}), b"PK\x03\x04" + draw.randbytes(99), b""])
        )
    if draw.random() < 0.5:
        manifest = json.loads((FLAT_POLICY.parent / "manifest.json").read_text())
        manifest["checkpoints"] = {"model_1.pt": hashlib.sha256(path.read_bytes()).hexdigest()}
        (folder / "manifest.json").write_text(json.dumps(manifest))
    elif draw.random() < 0.8:
        manifest = json.loads((FLAT_POLICY.parent / "manifest.json").read_text())
        manifest.pop("checkpoints")
        (folder / "manifest.json").write_text(json.dumps(manifest))
    command = draw.choice([["eval", *_TINY], ["eval", *_TINY], ["export", "--formats", "onnx", "--out", "out"]])
    return Case([("polypod", [*command, "--checkpoint", "model_1.pt"])])


# --- what polypod writes for itself


def sealed(body: bytes) -> bytes:
    """A body and its checksum, FNV-1a."""
    hashed = 0xCBF29CE484222325
    for byte in body:
        hashed = (hashed ^ byte) * 0x100000001B3 % 2**64
    return body + struct.pack("<Q", hashed)


@cache
def _dump(robot: str) -> bytes:
    import tempfile

    import numpy as np

    from polypod import _core

    # the least that a task takes, rad/s; a jump of the targets turns joints faster
    broken = "terminations.illegal_state.max_joint_vel=1"
    with tempfile.TemporaryDirectory() as folder:
        sim = _core.VecSim("velocity_flat_legged", 1, [robot], threads=1, overrides=[broken], dump_dir=folder)
        sim.step(np.full((1, sim.num_actions), 3.0, np.float32))
        (file,) = Path(folder).iterdir()
        return file.read_bytes()


def _dump_of_a_state(draw: random.Random, folder: Path) -> Case:
    data = _dump(draw.choice(["spot", "unitree_a1"]))
    if draw.random() < 0.85:
        data = sealed(bytes_changed(draw, data[:-8], draw.choice((1, 1, 2, 4))))
    else:
        data = bytes_changed(draw, data)
    (folder / "broken.polypod").write_bytes(data)
    return Case([("polypod-sim", ["replay", "broken.polypod"])])


def _snapshot(draw: random.Random, folder: Path) -> Case:
    return Case([], call={"seed": draw.randrange(2**31), "count": 1})


def reads_snapshots(seed: int, count: int) -> int:
    """Restores changed snapshots of both simulators and steps on.

    Returns 4 if a refused one changed the simulation.
    """
    import sys

    import numpy as np

    from polypod import _core

    draw = generator("snapshot", seed)
    for _ in range(count):
        if draw.random() < 0.7:
            robot = draw.choice(["spot", "cassie", "unitree_go2w"])
            engine = ["physics.engine=avian"] if draw.random() < 0.2 and robot == "spot" else []
            sim: Any = _core.VecSim("velocity_flat_legged", 2, [robot], threads=1, overrides=engine)
            shape = (2, sim.num_actions)

            def step(sim: Any = sim, shape: Any = shape) -> Any:
                sim.step(np.full(shape, 0.3, np.float32))
                return np.concatenate([sim.observation.ravel(), sim.reward.ravel()])
        else:
            sim = _core.Simulation(str(draw.choice(URDFS[:5])), num_envs=2, threads=1)

            def step(sim: Any = sim) -> Any:
                sim.step(n=2)
                return np.concatenate([sim.qpos.ravel(), sim.qvel.ravel()])

        step()
        home = sim.snapshot()
        new = bytes_changed(draw, home[:-8], draw.choice((1, 1, 2, 4)))
        try:
            sim.restore(sealed(new) if draw.random() < 0.9 else new)
        except _core.PolypodError:
            if sim.snapshot() != home:
                print("a refused snapshot changed the simulation", file=sys.stderr)
                return 4
        for _ in range(3):
            step()
    return 0


KINDS: dict[str, tuple[Callable[[random.Random, Path], Case], int]] = {
    "urdf": (_urdf, 280),
    "mesh": (_mesh, 140),
    "robot config": (_robot_config, 100),
    "task config": (_task_config, 80),
    "heightfield": (_heightfield, 60),
    "train config": (_train_config, 40),
    "sweep": (_sweep, 20),
    "manifest": (_manifest, 50),
    "exported manifest": (_exported_manifest, 50),
    "graph": (_graph, 80),
    "checkpoint": (_checkpoint, 80),
    "dump": (_dump_of_a_state, 60),
    "snapshot": (_snapshot, 60),
}
"""By kind of file, what writes one and how many of a thousand files are of it."""


def case(kind: str, index: int, folder: Path) -> Case:
    """Writes the files of the draw with this number into `folder`."""
    return KINDS[kind][0](generator("file", kind, index), folder)
