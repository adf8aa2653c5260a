"""Single numbers and arrays that a user gives, checked; what is wrong is said by the name of the argument.

`mechanics.spec` has its own: a file's data must have the right type, where an argument need only be convertible.
"""

from __future__ import annotations

import math
import reprlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["array", "number", "positive", "whole"]


def number(name: str, value: Any) -> float:
    """A number, perhaps not finite."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a number, got {reprlib.repr(value)}") from None


def positive(name: str, value: Any) -> float:
    """A positive finite number."""
    result = number(name, value)
    if not (math.isfinite(result) and result > 0):
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return result


def whole(name: str, value: Any) -> int:
    """A positive whole number."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be a positive whole number, got {value!r}")
    return int(value)


def array(what: str, value: Any, shape: tuple[int, ...], mask: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """An array of finite numbers of this shape; or with a mask, perhaps one for each row, of the rows in it."""
    try:
        result = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be a number or an array of numbers, got {reprlib.repr(value)}") from None
    shapes = [shape] if mask is None else [shape, (len(mask), *shape)]
    if result.shape not in shapes:
        raise ValueError(f"{what} must have shape {' or '.join(map(str, shapes))}, got {result.shape}")
    if mask is not None and result.shape != shape:
        result = result[mask]
    if not np.isfinite(result).all():
        raise ValueError(f"{what} must be finite, got {reprlib.repr(result.tolist())}")
    return result
