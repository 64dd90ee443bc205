"""Every public member has a docstring at run time, for `help`, IPython and the API pages."""

import ast
import importlib
import inspect
import itertools
import pkgutil
from pathlib import Path

import pytest

import polypod
from polypod import _core

STUB = Path(polypod.__file__).with_name("_core.pyi")
OPTIONAL = ("ray", "stable_baselines3", "torchrl")
"""Packages that adapters import and the tests may lack."""


def of_stub() -> dict[str, str]:
    """The docstrings of the stub; a class has its constructor's too."""
    found: dict[str, str] = {}
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef) or not hasattr(_core, node.name):
            continue
        found.setdefault(node.name, ast.get_docstring(node) or "")
        body = node.body if isinstance(node, ast.ClassDef) else []
        for member, following in itertools.zip_longest(body, body[1:]):
            if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                found[node.name] += f"\n\n{ast.get_docstring(member)}"
            elif isinstance(member, ast.FunctionDef) and not member.name.startswith("__"):
                found.setdefault(f"{node.name}.{member.name}", ast.get_docstring(member) or "")
            elif isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name):
                has_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                text = inspect.cleandoc(str(following.value.value)) if has_text else ""
                found[f"{node.name}.{member.target.id}"] = text
    return found


STUBS = of_stub()


def public_members() -> list[str]:
    """Names of what `_core` has, sorted: pyo3 has them in another order in every process."""
    # a constant is a number, which carries no docstring
    names = [name for name, value in vars(_core).items() if not name.startswith("_") and callable(value)]
    classes = [name for name in names if inspect.isclass(getattr(_core, name))]
    members = [
        f"{name}.{member}" for name in classes for member in vars(getattr(_core, name)) if not member.startswith("_")
    ]
    return sorted(names + members)


def test_the_stub_is_complete():
    assert len(STUBS) > 100
    assert set(public_members()) == set(STUBS)


@pytest.mark.parametrize("name", public_members())
def test_help_shows_what_the_stub_says(name):
    of_class, _, member = name.partition(".")
    found = getattr(_core, of_class)
    text = inspect.getdoc(vars(found)[member] if member else found)
    assert text, f"{name} has no docstring in {STUB.name}"
    assert text == STUBS[name]


def modules() -> list[str]:
    return ["polypod", *(found.name for found in pkgutil.walk_packages(polypod.__path__, "polypod."))]


@pytest.mark.parametrize("name", [name for name in modules() if not name.endswith("__main__")])
def test_what_python_defines_says_what_it_is(name):
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in OPTIONAL:
            raise
        pytest.skip(f"needs {error.name}: make test ONLY=learners")
    assert module.__doc__
    silent = [
        f"{member}"
        for member, value in vars(module).items()
        if not member.startswith("_") and getattr(value, "__module__", None) == name and callable(value)
        for member in silent_of(member, value)
    ]
    assert not silent


def silent_of(name, value):
    """Functions, classes, public methods and properties without a docstring."""
    if inspect.isclass(value):
        if not vars(value).get("__doc__"):
            yield name
        for member, of_class in vars(value).items():
            is_member = inspect.isroutine(of_class) or isinstance(of_class, property | classmethod | staticmethod)
            if not member.startswith("_") and is_member and not inspect.getdoc(getattr(value, member)):
                yield f"{name}.{member}"
    elif inspect.isfunction(value) and not value.__doc__:
        yield name
