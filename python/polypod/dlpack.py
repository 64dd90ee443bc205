"""DLPack capsules of arrays on a card: torch, JAX and CuPy read them without a copy."""

import ctypes
from typing import Any, ClassVar, Protocol


class Array(Protocol):
    """An array that a capsule shares, see `polypod._core.DeviceArray`."""

    @property
    def address(self) -> int:
        """Address of the first number."""

    @property
    def shape(self) -> list[int]:
        """Sizes, in the order of C."""

    @property
    def dtype(self) -> str:
        """float32 or bool."""

    def __dlpack_device__(self) -> tuple[int, int]:
        """Kind and number of the device."""


class _Device(ctypes.Structure):
    _fields_: ClassVar = [("kind", ctypes.c_int32), ("number", ctypes.c_int32)]


class _Type(ctypes.Structure):
    _fields_: ClassVar = [("code", ctypes.c_uint8), ("bits", ctypes.c_uint8), ("lanes", ctypes.c_uint16)]


class _Tensor(ctypes.Structure):
    _fields_: ClassVar = [
        ("data", ctypes.c_void_p),
        ("device", _Device),
        ("ndim", ctypes.c_int32),
        ("dtype", _Type),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
        ("strides", ctypes.POINTER(ctypes.c_int64)),
        ("byte_offset", ctypes.c_uint64),
    ]


_DELETER = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


class _Managed(ctypes.Structure):
    _fields_: ClassVar = [("tensor", _Tensor), ("context", ctypes.c_void_p), ("deleter", _DELETER)]


_TYPES = {"float32": (2, 32), "bool": (6, 8)}
"""Codes and bits of DLPack's types."""
_NAME = b"dltensor"
_shared: dict[int, tuple[Any, ...]] = {}
"""The structure of each consumer, and the array whose memory it reads."""


def _delete(address: int) -> None:
    _shared.pop(address, None)


def _delete_unused(capsule: int) -> None:
    """Frees a capsule whose tensor nobody took: a consumer renames it."""
    if _is_valid(capsule, _NAME):
        _delete(_pointer(capsule, _NAME))


_deleter, _destructor = _DELETER(_delete), _DELETER(_delete_unused)
"""Both functions as functions of C."""

_new = ctypes.pythonapi.PyCapsule_New
_new.restype, _new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_is_valid = ctypes.pythonapi.PyCapsule_IsValid
_is_valid.restype, _is_valid.argtypes = ctypes.c_int, [ctypes.c_void_p, ctypes.c_char_p]
_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_char_p]


def capsule(array: Array) -> Any:
    """A capsule with an array's memory, which the consumer keeps until it needs it no more."""
    sizes = (ctypes.c_int64 * len(array.shape))(*array.shape)
    code, bits = _TYPES[array.dtype]
    tensor = _Tensor(array.address, _Device(*array.__dlpack_device__()), len(sizes), _Type(code, bits, 1), sizes)
    managed = _Managed(tensor, None, _deleter)
    address = ctypes.addressof(managed)
    _shared[address] = (managed, sizes, array)
    return _new(address, _NAME, ctypes.cast(_destructor, ctypes.c_void_p))
