"""Programs that start without torch's compiler, which takes longer to import than torch.

polypod compiles nothing. Still, tensordict marks functions for the compiler when it is imported,
and optimisers do when they are built: each mark imports `torch._dynamo`. The programs of the
command line leave the marks out. Programs that import polypod keep them.
"""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

_MARKS = ("allow_in_graph", "assume_constant_result", "disable")
"""Functions of `torch.compiler` that mark another one when a module is imported."""
_MARKED = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
"""Methods of torch's optimisers that are marked in their first call, as `torch.manual_seed` is."""


def skip_compiler() -> None:
    """Lets this process import tensordict, and build optimisers, without torch's compiler.

    A version of torch or tensordict that marks in another way starts more slowly, and works.
    """
    sys.meta_path.insert(0, _WithoutMarks())


def import_compiler() -> None:
    """Imports torch's compiler, as the first step of an optimiser does, which is timed."""
    import torch._dynamo  # noqa: F401


class _WithoutMarks(MetaPathFinder):
    """Finds tensordict, as `PathFinder` does, and imports it without its marks."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != "tensordict":
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_unmarked(module: ModuleType) -> None:
            with _unmarked():
                execute(module)

        spec.loader.exec_module = execute_unmarked  # type: ignore[method-assign]
        return spec


@contextlib.contextmanager
def _unmarked() -> Iterator[None]:
    """Leaves out marks of functions while the context lasts, and those of optimisers for good."""
    import torch.compiler
    import torch.optim

    marks = {name: getattr(torch.compiler, name) for name in _MARKS}
    for name in _MARKS:
        setattr(torch.compiler, name, _as_it_is)
    for marked in (torch.manual_seed, *(getattr(torch.optim.Optimizer, name, None) for name in _MARKED)):
        function = getattr(marked, "__wrapped__", None)
        if function is not None:
            setattr(function, "__dynamo_disable", function)
    try:
        yield
    finally:
        for name, mark in marks.items():
            setattr(torch.compiler, name, mark)


def _as_it_is(function: Any = None, *_: Any, **__: Any) -> Any:
    """The function, or a decorator that returns it."""
    return _as_it_is if function is None else function
