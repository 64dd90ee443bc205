"""The stub of the compiled module names exactly what the module has."""

import ast
from pathlib import Path

import polypod
from polypod import _core


def stub():
    return ast.parse((Path(polypod.__file__).parent / "_core.pyi").read_text(encoding="utf-8"))


def names(body):
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.AnnAssign):
            yield node.target.id


def public(found):
    return {name for name in found if not name.startswith("_")}


def test_module():
    typed_dicts = {
        "TaskEntry",
        "RobotEntry",
        "CoreInfo",
        "TerrainEntry",
        "RobotDraft",
        "TrainFile",
        "TrainEntry",
        "Peers",
    }
    assert public(names(stub().body)) - typed_dicts <= public(dir(_core))


def members(name):
    (found,) = (node for node in stub().body if isinstance(node, ast.ClassDef) and node.name == name)
    return public(names(found.body))


def test_vec_sim(make):
    assert members("VecSim") == public(dir(make().sim))


def test_simulation():
    assert members("Simulation") == public(dir(_core.Simulation))
