"""The stub of the compiled module names exactly what the module has, with the same parameters."""

import ast
import inspect
from pathlib import Path

import pytest

import polypod
from polypod import _core

BODY = ast.parse((Path(polypod.__file__).parent / "_core.pyi").read_text(encoding="utf-8")).body
FUNCTIONS = {node.name: node for node in BODY if isinstance(node, ast.FunctionDef)}
CLASSES = {node.name: node for node in BODY if isinstance(node, ast.ClassDef)}
OF_STUB = {name for name, node in CLASSES.items() if {"TypedDict", "Protocol"} & {base.id for base in node.bases}}
"""Types of dictionaries and of arguments, which only the stub knows."""
COMPILED = ["Learner", "Simulation", "VecSim"]


def names(body):
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.AnnAssign):
            yield node.target.id


def public(found):
    return {name for name in found if not name.startswith("_")}


def stated(node, skipped=0):
    """Name, kind and whether it may be left out, of each parameter but the first `skipped`."""
    of, kinds = node.args, inspect.Parameter
    places = [*of.posonlyargs, *of.args]
    required = len(places) - len(of.defaults)
    found = [(arg.arg, kinds.POSITIONAL_OR_KEYWORD, place >= required) for place, arg in enumerate(places)][skipped:]
    if of.vararg is not None:
        found.append((of.vararg.arg, kinds.VAR_POSITIONAL, False))
    found += [
        (arg.arg, kinds.KEYWORD_ONLY, default is not None)
        for arg, default in zip(of.kwonlyargs, of.kw_defaults, strict=True)
    ]
    return found


def given(function, skipped=0):
    parameters = list(inspect.signature(function).parameters.values())[skipped:]
    return [(each.name, each.kind, each.default is not inspect.Parameter.empty) for each in parameters]


def methods(name):
    """Methods of a class by their names, without properties."""
    return {
        node.name: node
        for node in CLASSES[name].body
        if isinstance(node, ast.FunctionDef) and not node.decorator_list and not node.name.startswith("_")
    }


def test_module():
    assert public(names(BODY)) - OF_STUB <= public(dir(_core))
    assert public(_core.__all__) <= public(names(BODY))


@pytest.mark.parametrize("name", COMPILED)
def test_members(name):
    assert public(names(CLASSES[name].body)) == public(dir(getattr(_core, name)))


@pytest.mark.parametrize("name", sorted(public(FUNCTIONS)))
def test_parameters_of_functions(name):
    assert stated(FUNCTIONS[name]) == given(getattr(_core, name))


@pytest.mark.parametrize("name", COMPILED)
def test_parameters_of_methods(name):
    compiled = getattr(_core, name)
    (constructor,) = (node for node in CLASSES[name].body if getattr(node, "name", "") == "__init__")
    assert stated(constructor, 1) == given(compiled)
    found = {method: stated(node, 1) for method, node in methods(name).items()}
    assert found == {method: given(getattr(compiled, method), 1) for method in found}
    assert len(found) > 5
