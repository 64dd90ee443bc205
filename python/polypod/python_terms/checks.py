"""Checks of the arrays that terms in Python return."""

from typing import Any

import numpy as np
import numpy.typing as npt

from polypod._core import ConfigError

LARGEST = float(np.finfo(np.float32).max)
"""Largest number of float32."""


class Checks:
    """Reads what terms return; errors begin with the terms' source."""

    def __init__(self, source: str) -> None:
        """Names the source; empty: none."""
        self.begin = f"{source}: " if source else ""

    def array(self, what: str, value: Any) -> npt.NDArray[Any]:
        """Returns a term's value as an array. Raises ConfigError, which begins with `what`."""
        try:
            return np.asarray(value)
        except Exception as error:  # from the caller's type, such as a tensor that wants a gradient
            raise ConfigError(f"{self.begin}{what} gives no array: {error}; return a NumPy array") from error

    def numbers(self, what: str, value: Any) -> npt.NDArray[np.float64]:
        """Returns a term's value as numbers. Raises ConfigError."""
        array = self.array(what, value)
        if array.dtype.kind not in "fiub":
            raise ConfigError(f"{self.begin}{what} gives {array.dtype}; return numbers")
        return array.astype(np.float64)

    def shape(self, what: str, found: tuple[int, ...], wanted: tuple[int, ...]) -> None:
        """Raises ConfigError for another shape."""
        if found != wanted:
            raise ConfigError(f"{self.begin}{what} gives shape {found}; return one row per env, {wanted}")

    def finite(self, what: str, values: npt.NDArray[np.float64]) -> None:
        """Raises ConfigError for numbers that are not finite in float32."""
        wrong = ~(np.abs(values) <= LARGEST)
        if wrong.any():
            place = np.argwhere(wrong)[0]
            where = f"gives {values[tuple(place)]:.6g} for env {place[0]}" if place.size else f"is {values:.6g}"
            raise ConfigError(f"{self.begin}{what} {where}; only finite numbers that float32 holds are taken")

    def flags(self, what: str, value: Any, num_envs: int) -> npt.NDArray[np.bool_]:
        """Bools [num_envs]."""
        array = self.array(what, value)
        if array.dtype != np.bool_:
            raise ConfigError(f"{self.begin}{what} gives {array.dtype}; return bools, e.g. of a comparison")
        self.shape(what, array.shape, (num_envs,))
        return array

    def per_env(self, what: str, value: Any, valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
        """A finite number per env; 0 where `valid` is not set, whatever the term gives there."""
        array = self.numbers(what, value)
        self.shape(what, array.shape, valid.shape)
        array = np.where(valid, array, 0.0)
        self.finite(what, array)
        return array

    def rows(
        self, what: str, value: Any, shape: tuple[int, int], valid: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.float32]:
        """Finite float32 numbers of this shape; one number per row may have one dimension."""
        array = self.array(what, value)
        if array.dtype != np.float32:
            array = self.numbers(what, array)
        if array.ndim == 1 and shape[1] == 1:
            array = array[:, np.newaxis]
        self.shape(what, array.shape, shape)
        if not (np.abs(array) <= LARGEST).all():
            array = np.where(valid[:, np.newaxis], array, 0.0)
            self.finite(what, array.astype(np.float64))
        return array.astype(np.float32)
