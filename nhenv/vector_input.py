"""What a vector environment is given, checked: modes, numbers for each row, masks, seeds and actions."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import Error
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import unknown_name

__all__ = ["FLOATS", "Seeds", "actions", "arrays", "autoreset_mode", "first", "info_level", "mask", "seeds"]

Seeds = int | Sequence[int | None] | None

LEVELS = ("none", "final", "all")
FLOATS = {np.dtype(np.float32), np.dtype(np.float64)}  # what kernels read as it is, in the machine's own byte order


def autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Gymnasium's mode of this name."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ValueError(unknown_name("autoreset_mode", str(mode), [known.value for known in AutoresetMode])) from None


def info_level(level: str) -> str:
    """How much info is told."""
    if level not in LEVELS:
        raise ValueError(unknown_name("info level", str(level), LEVELS))
    return level


def arrays(
    what: str, given: Mapping[str, ArrayLike], size: int, *, numbers: bool = False
) -> dict[str, NDArray[np.float64]]:
    """Those of some values by name that are arrays, shape (N,); or `numbers` too, made arrays."""
    found = {}
    for name, value in given.items():
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            if np.ndim(np.asarray(value, dtype=object)) == 0 and not numbers:
                continue  # whoever takes single numbers will say what is wrong with this one
            raise ValueError(f"{what}: {name} must be a number or {size} of them, got {value!r}") from None
        if array.shape not in ((), (size,)):
            raise ValueError(f"{what}: {name} must be a number or have shape ({size},), got shape {array.shape}")
        if array.shape or numbers:
            found[str(name)] = np.array(np.broadcast_to(array, size))
    return found


def first(given: Mapping[str, Any], arrays: Mapping[str, NDArray[np.float64]]) -> dict[str, Any]:
    """What is given, with the first row's number in place of arrays."""
    return {**given, **{name: float(values[0]) for name, values in arrays.items()}}


def mask(what: str, given: NDArray[np.bool_] | None, size: int) -> NDArray[np.bool_]:
    """A mask of rows, (N,): as given, or all."""
    if given is None:
        return np.ones(size, np.bool_)
    if not isinstance(given, np.ndarray) or given.dtype != np.bool_ or given.shape != (size,):
        found = f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else repr(given)
        raise ValueError(f"{what} must be a NumPy array of bool of shape ({size},), got {found}")
    if not given.any():
        raise ValueError(f"{what} selects no row; leave it out for all rows")
    return np.array(given)


def seeds(given: Seeds, chosen: NDArray[np.int64], size: int) -> dict[int, int]:
    """Seed of each of the chosen rows that gets one."""
    if given is None:
        return {}
    each: Sequence[int | None] | range
    if isinstance(given, int | np.integer) and not isinstance(given, bool):
        each = range(int(given), int(given) + size)
    elif isinstance(given, Sequence | np.ndarray) and not isinstance(given, str | bytes):
        each = given
    else:
        raise ValueError(f"seed must be None, a whole number or one for each row, got {given!r}")
    if len(each) != size:
        raise ValueError(f"seed must be None, a whole number or {size} of them, got {len(each)}")
    try:
        found = {row: operator.index(each[row]) for row in chosen.tolist() if each[row] is not None}
    except TypeError:
        raise ValueError(f"seeds must be whole numbers or None, got {given!r}") from None
    if found and min(found.values()) < 0:
        raise Error(f"a seed must not be negative, got {min(found.values())}")
    return found


def actions(given: ArrayLike, shape: tuple[int, ...], controls: Sequence[str]) -> NDArray[Any]:
    """Actions as kernels take them: floats one after the other, which could be written to."""
    names = ", ".join(controls)
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "biufO":
            raise TypeError
        array = array.astype(np.float32 if array.dtype == np.float32 else float)
    except (TypeError, ValueError):
        raise ValueError(f"actions must be an array of shape {shape} ({names}), got {given!r}") from None
    if array.shape != shape:
        raise ValueError(f"actions must have shape {shape} (rows; {names}), got shape {array.shape}")
    return np.array(array, order="C")
