"""Expands one xacro file of a stranger, in a process that does nothing else.

It reads a request from its standard input and writes the expanded text to its standard output. The
package `xacro` evaluates the expressions of a file with Python's `eval`, behind a filter of names
that does not hold. Here an interpreter of arithmetic, comparisons, indices and a list of harmless
functions takes its place. The process has no environment, writes no files, and its memory and time
are bounded. Files are read in the folders of the request alone.

Nothing of polypod is imported: the file is run by its path.
"""

import ast
import io
import json
import math
import operator
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

MEMORY = 2 << 30
"""Largest memory, bytes."""
SECONDS = 60
"""Largest computing time."""
LONGEST = 1 << 20
"""Items of a sequence and letters of a text that an expression may make."""
LARGEST = 1 << 1024
"""Largest integer."""

_BUILTINS: dict[str, Callable[..., Any]] = {
    function.__name__: function
    for function in (abs, all, any, bool, dict, divmod, enumerate, float, int, len, list, max, min, reversed, round)
}
_BUILTINS |= {function.__name__: function for function in (set, sorted, str, sum, tuple, zip)}
# fmt: off
_MATH = (
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "copysign", "cos", "cosh", "degrees",
    "dist", "erf", "erfc", "exp", "exp2", "expm1", "fabs", "floor", "fmod", "fsum", "hypot", "isclose", "isfinite",
    "isinf", "isnan", "log", "log10", "log1p", "log2", "modf", "radians", "remainder", "sin", "sinh", "sqrt", "tan",
    "tanh", "trunc",
)
# fmt: on
_XACRO = ("load_yaml", "abs_filename", "dotify", "tokenize", "arg", "message", "warning", "error", "fatal")
_OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.Not: operator.not_,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


class RefusedError(Exception):
    """An expression or a file that is not evaluated or read."""


def evaluate(text: str, names: Callable[[str], Any], functions: dict[str, Callable[..., Any]]) -> Any:
    """The value of an expression.

    Args:
        text: the expression.
        names: the value of a name; raises KeyError.
        functions: what may be called, by dotted name.

    Raises:
        RefusedError: for what is neither arithmetic nor a call of these functions.
    """
    return _Interpreter(names, functions).of(ast.parse(text.strip(), mode="eval").body)


class _Interpreter:
    def __init__(self, names: Callable[[str], Any], functions: dict[str, Callable[..., Any]]) -> None:
        self.names, self.functions = names, functions

    def of(self, node: ast.expr) -> Any:
        handler = getattr(self, f"_{type(node).__name__.lower()}", None)
        if handler is None:
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: {type(node).__name__}")
        return _bounded(handler(node))

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        constants = {"True": True, "False": False, "true": True, "false": False, "None": None, "pi": math.pi}
        try:
            return self.names(node.id)
        except KeyError:
            if node.id in constants:
                return constants[node.id]
            raise NameError(f"name '{node.id}' is not defined") from None

    def _attribute(self, node: ast.Attribute) -> Any:
        if (
            isinstance(node.value, ast.Name)
            and node.value.id == "math"
            and node.attr in ("pi", "e", "tau", "inf", "nan")
        ):
            return getattr(math, node.attr)
        value = self.of(node.value)
        if not isinstance(value, dict) or node.attr.startswith("_"):
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: an attribute of what is no table")
        return value[node.attr]

    def _subscript(self, node: ast.Subscript) -> Any:
        value = self.of(node.value)
        if not isinstance(value, dict | list | tuple | str):
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: an index into what is no table, list or text")
        if isinstance(node.slice, ast.Slice):
            ends = (
                None if end is None else self.of(end) for end in (node.slice.lower, node.slice.upper, node.slice.step)
            )
            return value[slice(*ends)]
        return value[self.of(node.slice)]

    def _binop(self, node: ast.BinOp) -> Any:
        function = _OPERATORS.get(type(node.op))
        if function is None:
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: {type(node.op).__name__}")
        left, right = self.of(node.left), self.of(node.right)
        is_number = all(isinstance(value, int | float) for value in (left, right))
        if isinstance(node.op, ast.Add):
            is_number = is_number or (type(left) is type(right) and isinstance(left, str | list | tuple))
        if not is_number or (isinstance(node.op, ast.Pow) and isinstance(left, int) and abs(right) > 256):
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: these are no numbers, or too large")
        return function(left, right)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        function = _UNARY.get(type(node.op))
        if function is None:
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: {type(node.op).__name__}")
        return function(self.of(node.operand))

    def _boolop(self, node: ast.BoolOp) -> Any:
        value: Any = None
        for each in node.values:
            value = self.of(each)
            if bool(value) != isinstance(node.op, ast.And):
                break
        return value

    def _compare(self, node: ast.Compare) -> bool:
        left = self.of(node.left)
        for comparison, each in zip(node.ops, node.comparators, strict=True):
            right = self.of(each)
            if not _COMPARISONS[type(comparison)](left, right):
                return False
            left = right
        return True

    def _ifexp(self, node: ast.IfExp) -> Any:
        return self.of(node.body if self.of(node.test) else node.orelse)

    def _list(self, node: ast.List) -> list[Any]:
        return [self.of(each) for each in node.elts]

    def _tuple(self, node: ast.Tuple) -> tuple[Any, ...]:
        return tuple(self.of(each) for each in node.elts)

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        pairs = zip(node.keys, node.values, strict=True)
        return {self.of(key): self.of(value) for key, value in pairs if key is not None}

    def _call(self, node: ast.Call) -> Any:
        name = ast.unparse(node.func)
        function = self.functions.get(name)
        if function is None or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise RefusedError(f"{ast.unparse(node)!r} is not evaluated: {name} is none of the functions that are")
        arguments = [self.of(argument) for argument in node.args]
        named = {keyword.arg: self.of(keyword.value) for keyword in node.keywords if keyword.arg is not None}
        return function(*arguments, **named)


def _bounded(value: Any) -> Any:
    is_long = isinstance(value, str | list | tuple | dict | set) and len(value) > LONGEST
    if is_long or (isinstance(value, int) and abs(value) > LARGEST):
        raise RefusedError("a value of an expression is too large")
    return value


def _within_bounds() -> None:
    """Bounds memory, time and files of this process, where the system can."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in (("RLIMIT_AS", MEMORY), ("RLIMIT_CPU", SECONDS), ("RLIMIT_FSIZE", 0), ("RLIMIT_CORE", 0)):
        if hasattr(resource, kind):
            # the hard limit of computing time ends a process without a word
            resource.setrlimit(getattr(resource, kind), (most, most + (kind == "RLIMIT_CPU")))


def _opening(roots: list[Path]) -> Callable[..., io.TextIOWrapper]:
    """Python's `open` for reading, in these folders."""

    def guarded(name: Any, mode: str = "r", *_: Any, **__: Any) -> io.TextIOWrapper:
        place = Path(os.path.realpath(name))
        if mode not in ("r", "rt") or not any(place.is_relative_to(root) for root in roots):
            raise RefusedError(
                f"{name}: files outside the robot's folder are not read; copy it there, or name its package"
            )
        return place.open(encoding="utf-8")

    return guarded


def main() -> None:
    """Expands the file of the request on standard input."""
    request = json.loads(sys.stdin.read())
    sys.path[:] = request["path"]
    os.environ.clear()
    roots = [Path(os.path.realpath(root)) for root in request["roots"]]
    packages: dict[str, str] = request["packages"]
    import xacro
    import yaml  # noqa: F401 - before memory is bounded
    from xacro import substitution_args

    def find(name: str) -> str:
        if name in packages:
            return packages[name]
        for above in [Path(request["file"]).parent, *Path(request["file"]).parents]:
            place = above / name
            if place.is_dir() and any(Path(os.path.realpath(place)).is_relative_to(root) for root in roots):
                return str(place)
        raise RefusedError(f"package {name} is not found: name its folder with --package-dir {name}=FOLDER")

    functions: dict[str, Callable[..., Any]] = {}
    own = xacro._global_symbols["xacro"]
    for prefix in ("", "python."):
        functions |= {prefix + name: function for name, function in _BUILTINS.items()}
        functions[prefix + "range"] = lambda *ends: list(range(*ends)) if len(range(*ends)) <= LONGEST else None
    for prefix in ("", "math."):
        functions |= {prefix + name: getattr(math, name) for name in _MATH if hasattr(math, name)}
    functions |= {f"xacro.{name}": own[name] for name in _XACRO}
    functions |= {name: own[name] for name in ("load_yaml", "abs_filename", "dotify")}

    def of_expression(text: str, symbols: Any, _: Any = None) -> Any:
        return evaluate(text, lambda name: symbols[name], functions)

    def of_substitution(text: str, context: dict[str, Any]) -> str:
        arguments = context.setdefault("arg", {})

        def argument(name: str) -> Any:
            return substitution_args.convert_value(arguments[name], "auto")

        more: dict[str, Callable[..., Any]] = {
            "arg": argument,
            "dirname": lambda: str(Path(context["filename"]).parent),
            "find": find,
        }
        return str(evaluate(text, argument, functions | more))

    xacro.safe_eval = of_expression
    xacro.open = _opening(roots)
    substitution_args._eval = of_substitution
    substitution_args._eval_find = find
    _within_bounds()
    out = sys.stdout
    sys.stdout = sys.stderr
    try:
        document = xacro.process_file(request["file"], mappings=request["arguments"])
        out.write(json.dumps({"text": document.documentElement.toxml()}))
    except Exception as error:
        out.write(json.dumps({"error": f"{type(error).__name__}: {error}"[:2000]}))


if __name__ == "__main__":
    main()
