"""One helper for the value types: arrays that stay what they were."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def frozen(values: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """A read-only float64 copy of ``values``, of the given shape (None: any length).

    Raises:
        ValueError: another shape; the message quotes both.
    """
    array = np.array(values, dtype=np.float64)
    if array.size and (array.shape == shape or (shape[0] is None and array.shape[1:] == shape[1:])):
        # nearly always, and the tests below are slow
        array.setflags(write=False)
        return array
    if array.size == 0 and 0 in (0 if n is None else n for n in shape):
        array = array.reshape([0 if n is None else n for n in shape])
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise ValueError(f"expected an array of shape {shape}, got {array.shape}")
    array.flags.writeable = False
    return array


def frozen_index(values: ArrayLike) -> IntArray:
    """A read-only (k,) index array."""
    array = np.array(values, dtype=np.intp).reshape(-1)
    array.flags.writeable = False
    return array
