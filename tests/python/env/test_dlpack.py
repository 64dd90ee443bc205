"""Capsules of DLPack: memory that another library reads where it is, as long as it wants."""

import gc

import numpy as np
import pytest

from polypod import dlpack


class InHostMemory:
    """An array as the simulator hands it out, in memory of NumPy."""

    def __init__(self, numbers: np.ndarray) -> None:
        """Shares `numbers`."""
        self.numbers, self.address, self.shape, self.dtype = (
            numbers,
            numbers.ctypes.data,
            list(numbers.shape),
            str(numbers.dtype),
        )

    def __dlpack_device__(self) -> tuple[int, int]:
        """The host."""
        return 1, 0

    def __dlpack__(self, **_options: object) -> object:
        """The capsule."""
        return dlpack.capsule(self)


def test_torch_and_numpy_share_the_memory() -> None:
    torch = pytest.importorskip("torch")
    numbers = np.arange(12, dtype=np.float32).reshape(4, 3)
    tensor = torch.from_dlpack(InHostMemory(numbers))
    assert tensor.shape == (4, 3)
    assert tensor.dtype is torch.float32
    numbers[2, 1] = 40.0
    assert tensor[2, 1] == 40.0
    tensor[3, 0] = -1.0
    assert numbers[3, 0] == -1.0
    flags = torch.from_dlpack(InHostMemory(np.array([True, False, True])))
    assert flags.dtype is torch.bool
    assert flags.tolist() == [True, False, True]
    assert np.from_dlpack(InHostMemory(numbers)).tolist() == numbers.tolist()  # type: ignore[arg-type]


def test_the_memory_is_kept_while_it_is_read_and_no_longer() -> None:
    torch = pytest.importorskip("torch")
    before = len(dlpack._shared)
    tensor = torch.from_dlpack(InHostMemory(np.full(1000, 7.0, np.float32)))
    gc.collect()
    assert len(dlpack._shared) == before + 1
    assert tensor.sum() == 7000.0
    part = tensor[10:20]
    del tensor
    gc.collect()
    assert len(dlpack._shared) == before + 1
    assert part.sum() == 70.0
    del part
    gc.collect()
    assert len(dlpack._shared) == before
    # nor does a capsule that nobody takes keep it
    capsule = dlpack.capsule(InHostMemory(np.zeros(3, np.float32)))
    assert len(dlpack._shared) == before + 1
    del capsule
    gc.collect()
    assert len(dlpack._shared) == before
