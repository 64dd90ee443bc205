"""Steps robots on a GPU and compares their bits with those of the CPU's kernels.

Usage:
    tools/device_bits.py REFERENCE               compare every block of the reference
    tools/device_bits.py REFERENCE --time        then time the step

REFERENCE is what `cargo run --release -p polypod-cuda --example reference` writes, or that file
compressed by xz. The machine with the GPU needs its driver, NumPy and the NVRTC of torch's wheel;
with `--image FILE`, a PTX or CUBIN made elsewhere, NVRTC is not needed. It needs no Rust and no
CUDA toolkit. Exit code 0: all bits are the same; 1: some differ; 2: no GPU, or a broken file.
"""

import argparse
import ctypes
import lzma
import struct
import sys
import time
import zlib
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import ptx

DECIMATION = 4
"""Physics steps of a control step in the reference."""
WARP = 32
"""Threads of a warp, which are a block of the kernel."""
LISTED_SIZE = 4
"""Numbers of a listed contact: its number and its impulse."""
SCENES = ("plane", "rough", "slope", "nets", "stand", "move")
Arrays = dict[str, np.ndarray]


class DeviceError(Exception):
    """There is no GPU or no driver, or a call of the driver failed."""


def read_reference(path: Path) -> dict[str, Arrays]:
    """Arrays of each block, by `scene/robot`.

    Raises :class:`DeviceError` for a file that is no reference.
    """
    blocks: dict[str, Arrays] = defaultdict(dict)
    try:
        raw = path.read_bytes()
        data = lzma.decompress(raw) if path.suffix == ".xz" else raw
        at = 0
        while at < len(data):
            (length,) = struct.unpack_from("<I", data, at)
            name = data[at + 4 : at + 4 + length].decode()
            kind, count = struct.unpack_from("<cQ", data, at + 4 + length)
            at += 13 + length
            block, array = name.rsplit("/", 1)
            blocks[block][array] = np.frombuffer(data, "<f4" if kind == b"f" else "<i4", count, at)
            at += 4 * count
    except (OSError, lzma.LZMAError, struct.error, ValueError) as error:
        raise DeviceError(f"{path}: {error}; write it again by the example `reference`") from error
    if not blocks:
        raise DeviceError(f"{path}: holds no robots; write it again by the example `reference`")
    return blocks


def same_nan(words: np.ndarray) -> np.ndarray:
    """Bits of numbers of which every NaN has the bits of one: its payload is not promised."""
    return np.where(np.isnan(words.view(np.float32)), np.int32(0x7FC00000), words)


class Device:
    """The first GPU, through the driver's library alone."""

    def __init__(self) -> None:
        """Opens it; raises :class:`DeviceError` if there is none."""
        try:
            self.cuda = ctypes.CDLL("libcuda.so.1")
        except OSError as error:
            raise DeviceError("libcuda.so.1: not found; install the driver of an NVIDIA card") from error
        self.call("cuInit", 0)
        device, context = ctypes.c_int(), ctypes.c_void_p()
        self.call("cuDeviceGet", ctypes.byref(device), 0)
        self.call("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
        self.call("cuCtxSetCurrent", context)
        name = ctypes.create_string_buffer(100)
        self.call("cuDeviceGetName", name, 100, device)
        self.name = name.value.decode()

    def call(self, function: str, *arguments: Any) -> None:
        """Calls the driver; raises :class:`DeviceError` with the driver's text if it fails."""
        code = getattr(self.cuda, function)(*arguments)
        if code != 0:
            text = ctypes.c_char_p()
            self.cuda.cuGetErrorString(code, ctypes.byref(text))
            raise DeviceError(f"{function}: error {code}: {(text.value or b'').decode()}")

    def kernel(self, image: bytes) -> "Kernel":
        """The kernel of a PTX or CUBIN."""
        module, function, number = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
        begun = time.perf_counter()
        self.call("cuModuleLoadData", ctypes.byref(module), image + b"\0")
        loaded = time.perf_counter() - begun
        self.call("cuModuleGetFunction", ctypes.byref(function), module, b"polypod_control_step")
        numbers = []
        for attribute in (4, 3):
            self.call("cuFuncGetAttribute", ctypes.byref(number), attribute, function)
            numbers.append(number.value)
        return Kernel(self, module, function, numbers[0], numbers[1], loaded)

    def allocate(self, words: int) -> ctypes.c_uint64:
        """Memory of some words of four bytes, all zero."""
        pointer = ctypes.c_uint64()
        size = 4 * max(words, 1)
        self.call("cuMemAlloc_v2", ctypes.byref(pointer), ctypes.c_size_t(size))
        self.call("cuMemsetD8_v2", pointer, ctypes.c_ubyte(0), ctypes.c_size_t(size))
        return pointer

    def upload(self, pointer: ctypes.c_uint64, array: np.ndarray) -> None:
        """Copies an array to the device."""
        array = np.ascontiguousarray(array)
        if array.nbytes > 0:
            size = ctypes.c_size_t(array.nbytes)
            self.call("cuMemcpyHtoD_v2", pointer, ctypes.c_void_p(array.ctypes.data), size)

    def place(self, array: np.ndarray) -> ctypes.c_uint64:
        """Memory with an array in it."""
        pointer = self.allocate(array.size)
        self.upload(pointer, array)
        return pointer

    def download(self, pointer: ctypes.c_uint64, words: int) -> np.ndarray:
        """Words of the device, as integers."""
        out = np.empty(words, np.int32)
        if words > 0:
            self.call("cuMemcpyDtoH_v2", ctypes.c_void_p(out.ctypes.data), pointer, ctypes.c_size_t(out.nbytes))
        return out

    def wait(self) -> None:
        """Waits for all work of the device."""
        self.call("cuCtxSynchronize")

    def stream(self) -> ctypes.c_void_p:
        """A queue of work."""
        stream = ctypes.c_void_p()
        self.call("cuStreamCreate", ctypes.byref(stream), 1)
        return stream


class Kernel:
    """The compiled text of the device."""

    def __init__(
        self,
        device: Device,
        module: ctypes.c_void_p,
        function: ctypes.c_void_p,
        registers: int,
        local_bytes: int,
        loaded: float,
    ) -> None:
        """Keeps registers and bytes of local memory a thread, and seconds of loading."""
        self.device, self.module, self.function = device, module, function
        self.registers, self.local_bytes, self.loaded = registers, local_bytes, loaded


class Arguments(ctypes.Structure):
    """`Block` of `crates/cuda/device/step.cu`."""

    _fields_ = [
        *((name, ctypes.c_uint64) for name in ("integers", "numbers", "parameters", "common", "drive", "state")),
        *((name, ctypes.c_uint64) for name in ("report", "host", "grid", "work", "work_integers", "ended", "done")),
        *((name, ctypes.c_int) for name in ("robots", "own", "capacity", "first", "end", "warp", "number")),
    ]


def threads_of_robot() -> int:
    """Threads that step a robot together, as `crates/cuda/device/tables.h` says."""
    return ptx.constant("THREADS_OF_FEW")


class Robots:
    """A block of the reference on the device, each of its robots `copies` times."""

    def __init__(self, device: Device, arrays: Arrays, copies: int = 1) -> None:
        """Uploads them."""
        self.device, self.arrays, self.copies = device, arrays, copies
        envs, own, work, work_integers, steps, steps_of_drive, self.capacity = (int(x) for x in arrays["sizes"])
        self.steps, self.steps_of_drive = steps, steps_of_drive
        self.envs, self.robots = envs, envs * copies
        self.sizes = {name: arrays[f"last.{name}"].size // envs for name in ("state", "report")}
        drives = [arrays[f"drive.{k}"] for k in range(-(-self.steps // self.steps_of_drive))]
        self.drives = [device.place(self.tiles(drive)) for drive in drives]
        self.pointers = {
            "integers": device.place(arrays["integers"]),
            "numbers": device.place(arrays["numbers"]),
            "parameters": device.place(self.tiles(arrays["parameters"])),
            "common": device.place(arrays["common"]),
            "state": device.place(self.tiles(arrays["state"])),
            "grid": device.place(arrays["grid"]),
            "report": device.allocate(self.sizes["report"] * self.robots),
            "work": device.allocate(work * self.robots),
            "work_integers": device.allocate(work_integers * self.robots),
        }
        self.words = {"work": work + work_integers, "integers": arrays["integers"].size, **self.sizes}
        self.arguments = Arguments(robots=self.robots, own=own, capacity=self.capacity)
        for name, pointer in self.pointers.items():
            setattr(self.arguments, name, pointer.value)

    def tiles(self, array: np.ndarray) -> np.ndarray:
        """Rows, or tiles of parameters, of all copies."""
        return np.tile(array, self.copies)

    def restart(self) -> None:
        """Gives the robots their first states again."""
        self.device.upload(self.pointers["state"], self.tiles(self.arrays["state"]))

    def part(self, step: int, substeps: tuple[int, int], warp: int) -> Arguments:
        """Arguments of a control step or a part of it; `warp` is the first of the block's warps."""
        self.arguments.drive = self.drives[step // self.steps_of_drive].value
        (self.arguments.first, self.arguments.end), self.arguments.warp = substeps, warp
        return self.arguments

    def step(self, kernel: Kernel, step: int, substeps: Iterable[tuple[int, int]] = ((0, DECIMATION),)) -> None:
        """Makes a control step, in one launch or several."""
        for part in substeps:
            launch = Launch(self.device, [self], step, part)
            launch.run(kernel)
            self.device.wait()
            launch.free()

    def read(self, name: str) -> np.ndarray:
        """Rows of the device, as integers, without numbers behind the ends of lists."""
        words = same_nan(self.device.download(self.pointers[name], self.sizes[name] * self.robots))
        if name == "state":
            rows = words.reshape(-1, self.sizes[name])
            length = self.sizes[name] - 1 - LISTED_SIZE * self.capacity
            counts, listed = rows[:, length].view(np.float32), rows[:, length + 1 :]
            entries = np.arange(LISTED_SIZE * self.capacity) // LISTED_SIZE
            listed[entries[None, :] >= counts[:, None]] = 0
        return words

    def differing(self) -> dict[str, int]:
        """Numbers that differ after the last step, by array; every copy is looked at."""
        found = {}
        for name in self.sizes:
            last = same_nan(self.tiles(self.arrays[f"last.{name}"].view(np.int32)))
            found[name] = int((self.read(name) != last).sum())
        return found

    def free(self) -> None:
        """Gives the memory back."""
        for pointer in [*self.pointers.values(), *self.drives]:
            self.device.call("cuMemFree_v2", pointer)


class Launch:
    """One launch for all robots of some blocks."""

    def __init__(self, device: Device, blocks: list[Robots], step: int, substeps: tuple[int, int]) -> None:
        """Places the arguments on the device."""
        self.device, self.count, self.warps, raw = device, ctypes.c_int(len(blocks)), 0, b""
        for robots in blocks:
            raw += bytes(robots.part(step, substeps, self.warps))
            self.warps += -(-robots.robots * threads_of_robot() // WARP)
        self.blocks = device.place(np.frombuffer(raw, np.int32))

    def run(self, kernel: Kernel) -> None:
        """Begins the step."""
        pointers = (ctypes.c_void_p * 2)(ctypes.addressof(self.blocks), ctypes.addressof(self.count))
        shared = ctypes.c_uint(0)
        self.device.call("cuLaunchKernel", kernel.function, self.warps, 1, 1, WARP, 1, 1, shared, None, pointers, None)

    def free(self) -> None:
        """Gives the memory back."""
        self.device.call("cuMemFree_v2", self.blocks)


def compare(device: Device, kernel: Kernel, name: str, arrays: Arrays) -> str:
    """Steps a block and compares it after each control step. Returns what differs first, or ''."""
    robots = Robots(device, arrays)
    expected = arrays["checksums"].view(np.uint32).reshape(-1, 2)
    problem = ""
    for step in range(robots.steps):
        # launches of single physics steps give the same bits
        substeps = ((0, DECIMATION),) if step % 2 == 0 else ((0, 1), (1, DECIMATION))
        robots.step(kernel, step, substeps)
        for place, part in enumerate(robots.sizes):
            if zlib.crc32(robots.read(part).tobytes()) != expected[step][place]:
                problem = problem or f"{part} differs after control step {step}"
    differing = {part: count for part, count in robots.differing().items() if count}
    if differing and not problem:
        problem = "checksums agree, and the last rows do not"
    robots.free()
    return f"{name}: {problem}, at the end {differing}" if problem else ""


def compare_all(device: Device, kernel: Kernel, blocks: dict[str, Arrays]) -> list[str]:
    """Compares all blocks, and prints a line a scene. Returns what differs."""
    problems = []
    for scene in SCENES:
        begun = time.perf_counter()
        names = [name for name in blocks if name.startswith(f"{scene}/")]
        found = [problem for name in names if (problem := compare(device, kernel, name, blocks[name]))]
        steps = sum(int(blocks[name]["sizes"][0] * blocks[name]["sizes"][4]) * DECIMATION for name in names)
        seconds = time.perf_counter() - begun
        print(
            f"{scene:6} {len(names):3} morphologies {steps:8} physics steps: "
            f"{len(names) - len(found)} with equal bits ({seconds:.1f} s)",
            flush=True,
        )
        problems += found
    return problems


def measure(device: Device, kernel: Kernel, all_robots: list[Robots]) -> float:
    """Physics steps/s of blocks that step in one launch: the median of the control steps."""
    steps, of_drive = min(robots.steps for robots in all_robots), all_robots[0].steps_of_drive
    launches = [Launch(device, all_robots, step, (0, DECIMATION)) for step in range(0, steps, of_drive)]
    for robots in all_robots:
        robots.restart()
    device.wait()
    seconds = []
    for step in range(steps):
        begun = time.perf_counter()
        launches[step // of_drive].run(kernel)
        device.wait()
        seconds.append(time.perf_counter() - begun)
    for launch in launches:
        launch.free()
    late = sorted(seconds[steps // 4 :])
    return sum(robots.robots for robots in all_robots) * DECIMATION / late[len(late) // 2]


def time_blocks(
    device: Device, kernel: Kernel, blocks: dict[str, Arrays], label: str, robot_name: str | None, sizes: list[int]
) -> bool:
    """Times one robot and all of the reference task at once. Returns whether bits were kept."""
    good = True
    for scene in ("stand", "move"):
        names = [name for name in blocks if name.startswith(f"{scene}/")]
        single = [name for name in names if robot_name in (None, name.split("/")[1])][:1]
        cases = [(name.split("/")[1], [name], size) for name in single for size in sizes]
        if names:
            cases.append((f"all {len(names)}", names, sizes[-1]))
        for robot, chosen, size in cases:
            copies = max(1, size // len(chosen) // int(blocks[chosen[0]]["sizes"][0]))
            all_robots = [Robots(device, blocks[name], copies) for name in chosen]
            rate = measure(device, kernel, all_robots)
            kept = not any(sum(robots.differing().values()) for robots in all_robots)
            good &= kept
            words = all_robots[0].words
            print(
                f"{label:12} {scene:6} {robot:12} {size:6} robots, million physics steps/s: {rate / 1e6:7.2f}"
                f"  bits {'equal' if kept else 'DIFFER'}  words a robot {words}",
                flush=True,
            )
            for robots in all_robots:
                robots.free()
    return good


def main() -> int:
    """Compares, then times."""
    parser = argparse.ArgumentParser(description="Compare the steps of a GPU with those of the CPU's kernels.")
    parser.add_argument("reference", type=Path, help="file of the example `reference`, or its .xz")
    parser.add_argument("--image", type=Path, help="PTX or CUBIN (default: compiled here by NVRTC)")
    parser.add_argument("--time", action="store_true", help="time the step too")
    parser.add_argument("--robot", help="robot of the reference task that is timed alone (default: the first)")
    options = parser.parse_args()
    try:
        blocks = read_reference(options.reference)
        device = Device()
        image = options.image.read_bytes() if options.image else ptx.compile_text(ptx.find_nvrtc()).encode()
        kernel = device.kernel(image)
        print(
            f"{device.name}: {kernel.registers} registers, {kernel.local_bytes} bytes of local memory a thread, "
            f"loaded in {kernel.loaded:.1f} s",
            flush=True,
        )
        problems = compare_all(device, kernel, blocks)
        for problem in problems:
            print(problem, file=sys.stderr)
        good = not options.time or time_blocks(device, kernel, blocks, "step", options.robot, [1024, 4096, 16384])
    except (DeviceError, ptx.NvrtcError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 1 if problems or not good else 0


if __name__ == "__main__":
    sys.exit(main())
