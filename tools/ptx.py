"""Compiles the text of the device (crates/cuda/device) to PTX and reads it for inexact operations.

Usage:
    tools/ptx.py                     compile for compute_80 to target/polypod_cuda.ptx
    tools/ptx.py --arch compute_90   for newer cards
    tools/ptx.py --out FILE          write it somewhere else
    tools/ptx.py --package           write what a wheel ships to python/polypod/kernels

NVRTC compiles it. torch's wheel for Linux brings NVRTC, which needs no GPU and no CUDA toolkit. The
bits of a CPU are those of single IEEE 754 operations, each rounded to nearest. PTX without `.rn`
may be contracted, `.ftz` flushes subnormal numbers to zero, and `.approx` is not correctly rounded:
the command refuses PTX with any of them, with exit code 1. Needs the standard library alone.

A wheel that is built without NVRTC ships no PTX: a card's first simulation compiles the text then.
"""

import argparse
import ctypes
import ctypes.util
import importlib.util
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEVICE = ROOT / "crates" / "cuda" / "device"
FLAGS = ("--fmad=false", "--ftz=false", "--prec-div=true", "--prec-sqrt=true")
"""Flags of NVRTC that keep each operation as it is written; the defaults contract."""
PACKAGE = ROOT / "python" / "polypod" / "kernels"
"""Folder of the PTX that a wheel ships."""
UPDATE = "learn.cu"
"""The program of the native learner's update."""
ROUNDED = frozenset({"add", "sub", "mul", "div", "fma", "sqrt", "rcp"})
"""Operations that must say that they round to nearest."""
INEXACT = frozenset({"mad", "rsqrt", "sin", "cos", "tanh", "ex2", "lg2"})
"""Operations that no machine promises the bits of."""
OLDEST = {"compute_80": "7.0"}
"""The oldest version of PTX that has an architecture: a driver refuses a newer one than its own."""
HINT = re.compile(r'^\s*\.pragma "used_bytes_mask[^\n]*\n', re.MULTILINE)
"""A hint to the assembler that older versions lack; it changes no result."""
INSTRUCTION = re.compile(r"^\s*(?:@!?%\w+\s+)?([a-z][a-z0-9]*(?:\.[a-z0-9_:]+)+)\s")


class NvrtcError(Exception):
    """NVRTC is missing, or it refuses the text."""


class MissingNvrtcError(NvrtcError):
    """There is no NVRTC."""


def find_nvrtc() -> Path:
    """The library of NVRTC that torch's wheel brings, or else the one of the system.

    Raises :class:`MissingNvrtcError` if there is none.
    """
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        found = sorted(Path(folder).glob("*/lib/libnvrtc.so.*"))
        if found:
            return found[-1]
    name = ctypes.util.find_library("nvrtc")
    if name is None:
        raise MissingNvrtcError("libnvrtc: not found; install torch for CUDA, whose wheel brings it")
    return Path(name)


def compile_text(
    library: Path,
    arch: str = "compute_80",
    flags: tuple[str, ...] = FLAGS,
    source: str | None = None,
    program: str = "step.cu",
) -> str:
    """PTX of a program of the device, or of another `source`, in the oldest version that will do.

    Raises :class:`NvrtcError` with NVRTC's log if the text does not compile.
    """
    try:
        nvrtc = ctypes.CDLL(str(library))
    except OSError as error:
        raise NvrtcError(f"{library}: {error}; install torch for CUDA again") from error
    text = (DEVICE / program).read_text(encoding="utf-8") if source is None else source
    handle = ctypes.c_void_p()
    created = nvrtc.nvrtcCreateProgram(ctypes.byref(handle), text.encode(), program.encode(), 0, None, None)
    if created != 0:
        raise NvrtcError(f"{library}: error {created} of nvrtcCreateProgram")
    try:
        options = [f"--gpu-architecture={arch}", f"--include-path={DEVICE}", *flags]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if nvrtc.nvrtcCompileProgram(handle, len(options), array) != 0:
            log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, handle)
            raise NvrtcError(f"crates/cuda/device: NVRTC refuses the text for {arch}:\n{log}")
        ptx = _read(nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX, handle)
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(handle))
    if arch not in OLDEST:
        return ptx
    return re.sub(r"^\.version \S+", f".version {OLDEST[arch]}", HINT.sub("", ptx), flags=re.MULTILINE)


def _read(size_of: "ctypes._FuncPointer", get: "ctypes._FuncPointer", program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    size_of(program, ctypes.byref(size))
    buffer = ctypes.create_string_buffer(size.value)
    get(program, buffer)
    return buffer.value.decode()


def constant(name: str) -> int:
    """A number of the enumerations in `tables.h` that stands there as digits."""
    found = re.search(rf"\b{name} = (\d+)", (DEVICE / "tables.h").read_text(encoding="utf-8"))
    if found is None:
        raise NvrtcError(f"crates/cuda/device/tables.h: {name} has no number")
    return int(found[1])


def operations(ptx: str) -> dict[str, int]:
    """Instructions with their suffixes, and how often each stands in the PTX."""
    found: dict[str, int] = {}
    for line in ptx.splitlines():
        match = INSTRUCTION.match(line)
        if match:
            found[match[1]] = found.get(match[1], 0) + 1
    return found


def inexact(ptx: str, *, has_doubles: bool = False) -> list[str]:
    """Instructions whose bits a CPU need not share, each with the reason.

    `has_doubles`: the CPU computes in double precision too, as the learner does in sums.
    """
    problems = []
    for name, count in sorted(operations(ptx).items()):
        operation, *suffixes = name.split(".")
        if not any(re.fullmatch(r"b?f(16|32|64)(x2)?", suffix) for suffix in suffixes):
            continue
        if "approx" in suffixes or "full" in suffixes or operation in INEXACT:
            problems.append(f"{name} ({count} times): not correctly rounded")
        elif "ftz" in suffixes:
            problems.append(f"{name} ({count} times): flushes subnormal numbers to zero")
        elif operation in ROUNDED and "rn" not in suffixes:
            problems.append(f"{name} ({count} times): may be contracted")
        elif "f64" in suffixes and not has_doubles:
            problems.append(f"{name} ({count} times): in double precision, as no kernel is")
    # with a number that is no NaN, the instruction is what a comparison and a choice give
    choices = re.findall(r"^\s*(?:@!?%\w+\s+)?((?:min|max)\.f32)\s([^;]*);", ptx, re.MULTILINE)
    unclear = [name for name, operands in choices if "0f" not in operands]
    if unclear:
        problems.append(f"{unclear[0]} ({len(unclear)} times): of two variables, which may be NaN")
    return problems


def text_hash() -> str:
    """FNV-1a hash of all texts and their names, as `crates/cuda/build.rs` computes it."""
    value = 0xCBF29CE484222325
    for path in sorted(DEVICE.iterdir()):
        for byte in path.name.encode() + path.read_bytes():
            value = (value ^ byte) * 0x100000001B3 % 2**64
    return f"{value:016x}"


def programs() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Files that a wheel ships: the program of each, and its flags besides `FLAGS`.

    Their names say how many threads step a robot: those of few robots, or one. The update has 1.
    """
    few, warp = constant("THREADS_OF_FEW"), constant("WARP")
    files = {}
    for threads in (few, 1):
        files[f"step-{threads}.ptx"] = ("step.cu", (f"-DLANES={threads}",))
        files[f"env-{threads}.ptx"] = ("env.cu", ("-DLANES=1", f"-DTILE={warp // threads}"))
    return {**files, "learn-1.ptx": (UPDATE, ("-DLANES=1",))}


def compiled(arch: str = "compute_80") -> dict[str, str]:
    """PTX of all programs for an architecture, by the files of :func:`programs`.

    Raises :class:`NvrtcError` if NVRTC is missing or refuses the text.
    """
    library = find_nvrtc()
    return {
        name: compile_text(library, arch, (*FLAGS, *flags), program=program)
        for name, (program, flags) in programs().items()
    }


def all_inexact(made: dict[str, str]) -> list[str]:
    """:func:`inexact` of all programs, by their files."""
    of_update = {name for name, (program, _) in programs().items() if program == UPDATE}
    return [problem for name, ptx in made.items() for problem in inexact(ptx, has_doubles=name in of_update)]


def write_package() -> list[str]:
    """Writes the PTX that a wheel ships; returns what is wrong with it.

    Raises :class:`NvrtcError` if NVRTC is missing or refuses the text. Older files are gone then.
    """
    PACKAGE.mkdir(exist_ok=True)
    for old in PACKAGE.glob("*.ptx"):
        old.unlink()
    made, made_of = compiled(), text_hash()
    for name, ptx in made.items():
        (PACKAGE / name).write_text(f"// {made_of}\n{ptx}// end\n", encoding="utf-8", newline="\n")
        print(f"{PACKAGE / name}: {len(ptx)} bytes")
    return all_inexact(made)


def write_step(arch: str, out: Path) -> list[str]:
    """Writes the PTX of the physics step for an architecture; returns what is wrong with all PTX.

    Raises :class:`NvrtcError` if NVRTC is missing or refuses the text.
    """
    made = compiled(arch)
    problems = all_inexact(made)
    if not problems:
        step = next(iter(made.values()))
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(step, encoding="utf-8")
        print(f"{out}: {len(step)} bytes for {arch}")
    return problems


def main() -> int:
    """Compiles, reads and writes the PTX."""
    parser = argparse.ArgumentParser(description="Compile the text of the device to PTX.")
    parser.add_argument("--arch", default="compute_80", help="virtual architecture, e.g. compute_90")
    parser.add_argument("--out", type=Path, default=ROOT / "target" / "polypod_cuda.ptx")
    parser.add_argument("--package", action="store_true", help="write the PTX that a wheel ships")
    options = parser.parse_args()
    try:
        problems = write_package() if options.package else write_step(options.arch, options.out)
    except MissingNvrtcError as error:
        print(error, file=sys.stderr)
        if options.package:
            print("The wheel ships no kernels: a card's first simulation compiles them.", file=sys.stderr)
        return 0 if options.package else 2
    except NvrtcError as error:
        print(error, file=sys.stderr)
        return 2
    for problem in problems:
        print(f"crates/cuda/device: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
