"""The text of the device becomes PTX that rounds each operation as a CPU does.

NVRTC needs no GPU. Where it is absent, the tests are skipped and say so.
"""

import ctypes
import sys
from pathlib import Path

import pytest

from common import ROOT
from polypod import _core

sys.path.insert(0, str(ROOT / "tools"))
import ptx

SOURCE = """
extern "C" __global__ void probe(const float *a, const float *b, float *o) {
    float x = a[threadIdx.x], y = b[threadIdx.x];
    o[0] = x * y + o[1];
    o[2] = x + y;
    o[3] = x / y;
    o[4] = sqrtf(x);
    o[5] = fmaf(x, y, o[6]);
}
"""
"""Every rounded operation, and a product and a sum that a compiler may contract."""


@pytest.fixture(scope="module")
def nvrtc() -> Path:
    """The library of NVRTC."""
    try:
        return ptx.find_nvrtc()
    except ptx.NvrtcError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module", params=["step-1.ptx", "step-4.ptx", "env-4.ptx"])
def text(nvrtc: Path, request: pytest.FixtureRequest) -> str:
    """PTX of the physics with as many threads for a robot, and of the envs around it."""
    program, flags = ptx.programs()[request.param]
    return ptx.compile_text(nvrtc, flags=(*ptx.FLAGS, *flags), program=program)


def test_the_text_rounds_every_operation_to_nearest(text: str) -> None:
    assert ptx.inexact(text) == []
    found = ptx.operations(text)
    for operation in ("add", "sub", "mul", "div", "fma", "sqrt"):
        assert found.get(f"{operation}.rn.f32", 0) > 0, operation
    assert ".entry polypod_control_step" in text or ".entry polypod_env_step" in text


def test_drivers_since_cuda_11_take_the_text(nvrtc: Path, text: str) -> None:
    assert "\n.version 7.0\n" in text
    found = sorted(nvrtc.parent.glob("libnvJitLink.so.*"))
    if not found:
        pytest.skip("libnvJitLink, the driver's assembler as a library: not found beside NVRTC")
    linker = ctypes.CDLL(str(found[-1]))
    program = ctypes.c_void_p()
    options = (ctypes.c_char_p * 1)(b"-arch=sm_80")
    assert linker.nvJitLinkCreate(ctypes.byref(program), 1, options) == 0
    # 2: PTX; it is assembled at once
    added = linker.nvJitLinkAddData(program, 2, text.encode(), len(text), b"step.ptx")
    size = ctypes.c_size_t()
    linker.nvJitLinkGetErrorLogSize(program, ctypes.byref(size))
    log = ctypes.create_string_buffer(size.value + 1)
    linker.nvJitLinkGetErrorLog(program, log)
    linker.nvJitLinkDestroy(ctypes.byref(program))
    assert added == 0, log.value.decode()


def test_the_update_rounds_every_operation_to_nearest(nvrtc: Path) -> None:
    program, flags = ptx.programs()["learn-1.ptx"]
    text = ptx.compile_text(nvrtc, flags=(*ptx.FLAGS, *flags), program=program)
    assert ptx.inexact(text, has_doubles=True) == []
    assert "in double precision" in ptx.inexact(text)[0]
    found = ptx.operations(text)
    for operation in ("add.rn.f32", "mul.rn.f32", "div.rn.f32", "fma.rn.f32", "sqrt.rn.f32", "add.rn.f64"):
        assert found.get(operation, 0) > 0, operation
    assert not any(name.startswith("fma") and name.endswith("f64") for name in found)
    kernels = ("rows", "inputs", "product", "surrogate", "value", "chains", "weights", "total", "step")
    assert all(f".entry polypod_learn_{kernel}(" in text for kernel in kernels)


def test_the_extension_takes_kernels_of_this_text() -> None:
    extension = Path(_core.__file__).read_bytes()
    assert f"// {ptx.text_hash()}\n".encode() in extension
    for name in ptx.programs():
        assert name.split("-")[0].encode() + b".cu" in extension


def test_a_package_without_nvrtc_ships_no_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent() -> Path:
        raise ptx.MissingNvrtcError("libnvrtc: not found")

    monkeypatch.setattr(ptx, "PACKAGE", tmp_path)
    monkeypatch.setattr(ptx, "find_nvrtc", absent)
    monkeypatch.setattr(sys, "argv", ["ptx.py", "--package"])
    (tmp_path / "step-1.ptx").write_text("of another text")
    assert ptx.main() == 0
    assert list(tmp_path.iterdir()) == []
    assert "ships no kernels" in capsys.readouterr().err


def test_right_flags_keep_each_operation_as_it_is_written(nvrtc: Path) -> None:
    text = ptx.compile_text(nvrtc, source=SOURCE)
    assert ptx.inexact(text) == []
    found = ptx.operations(text)
    rounded = {name: count for name, count in found.items() if ".rn." in name}
    assert rounded == {
        "add.rn.f32": 2,
        "mul.rn.f32": 1,
        "div.rn.f32": 1,
        "sqrt.rn.f32": 1,
        "fma.rn.f32": 1,
    }


@pytest.mark.parametrize(
    ("flag", "reason"),
    [
        ("--fmad=true", "may be contracted"),
        ("--ftz=true", "flushes subnormal numbers"),
        ("--prec-div=false", "not correctly rounded"),
        ("--prec-sqrt=false", "not correctly rounded"),
        ("--use_fast_math", "not correctly rounded"),
    ],
)
def test_a_wrong_flag_is_found(nvrtc: Path, flag: str, reason: str) -> None:
    name = flag.split("=")[0]
    right = tuple(own for own in ptx.FLAGS if own.split("=")[0] != name)
    flags = (flag,) if flag == "--use_fast_math" else (*right, flag)
    problems = ptx.inexact(ptx.compile_text(nvrtc, flags=flags, source=SOURCE))
    assert any(reason in problem for problem in problems), problems


@pytest.mark.parametrize(
    ("instruction", "reason"),
    [
        ("max.f32 %f1, %f2, %f3;", "may be NaN"),
        ("sin.approx.f32 %f1, %f2;", "not correctly rounded"),
        ("add.f64 %fd1, %fd2, %fd3;", "may be contracted"),
        ("add.rn.f64 %fd1, %fd2, %fd3;", "double precision"),
        ("@%p1 mul.f32 %f1, %f2, %f3;", "may be contracted"),
    ],
)
def test_a_doubtful_instruction_is_found(instruction: str, reason: str) -> None:
    fine = "\tadd.rn.f32 \t%f1, %f2, %f3;\n\tmax.f32 \t%f1, %f2, 0f00000000;\n"
    assert ptx.inexact(fine) == []
    (problem,) = ptx.inexact(f"{fine}\t{instruction}\n")
    assert reason in problem


def test_a_text_that_does_not_compile_is_refused_with_the_log(nvrtc: Path) -> None:
    with pytest.raises(ptx.NvrtcError, match=r"(?s)crates/cuda/device.*nonsense"):
        ptx.compile_text(nvrtc, source="nonsense")
