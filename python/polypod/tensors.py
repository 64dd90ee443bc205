"""Tensors over arrays that are for reading, and the threads that compute with tensors."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import torch


class _Memory:
    """The memory of an array, without its guard against writing."""

    def __init__(self, array: npt.NDArray[Any]) -> None:
        interface = dict(array.__array_interface__)
        interface["data"] = (interface["data"][0], False)
        self.__array_interface__ = interface
        self._kept = array


def tensor_over(array: npt.NDArray[Any]) -> torch.Tensor:
    """A tensor over an array's memory, for reading alone.

    torch warns of memory that is guarded against writing, as the simulator's is.
    """
    return torch.from_numpy(array if array.flags.writeable else np.asarray(_Memory(array)))


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Lets torch compute on `count` threads while the context lasts.

    One is best for small batches: they are no faster on several, and far slower on a busy machine.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
