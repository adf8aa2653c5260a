"""Where a function of time jumps: an adaptive solver must stop there, or pays with its accuracy.

Controls are often held and then switched. A Runge-Kutta step across a switch has an error that its
estimate does not see, so `simulate` asks here before each step and lands on the switch instead.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["first_jump"]

Function = Callable[[float], NDArray[np.float64]]

CELLS = 8  # looked at in a step of the solver, whose own stages are twelve
# How far the middle of a cell may lie from the chord, of the change over the cell: 0.5 if the
# whole change is a jump, 0.1 for a quarter of a period of a sine, less for anything smoother.
CHORD = 0.2
# Halving a cell halves the change of a smooth function; ten halvings leave a jump as it was.
HALVINGS = 10
SHRINKAGE = 0.1


def first_jump(function: Function, start: float, end: float) -> tuple[float, float] | None:
    """Two neighbouring numbers in [start, end] between which `function` jumps first, or None.

    A jump is found if it changes the values at the ends or middles of the cells into which the
    interval is divided; a pulse that fits between two of them is not.
    """
    found = None
    while (jump := _some_jump(function, start, end)) is not None:
        found = jump
        end = jump[0]
        if not start < end:
            break
    return found


def _some_jump(function: Function, start: float, end: float) -> tuple[float, float] | None:
    times = np.linspace(start, end, 2 * CELLS + 1).tolist()
    values = [function(time) for time in times]
    for i in range(0, 2 * CELLS, 2):
        change = np.abs(values[i + 2] - values[i]).max()
        bend = np.abs(values[i + 1] - 0.5 * (values[i] + values[i + 2])).max()
        if bend > CHORD * change or bend > 0 == change:
            for left in (i, i + 1):
                jump = _close_in(function, times[left], times[left + 1], values[left], values[left + 1])
                if jump is not None:
                    return jump
    return None


def _close_in(
    function: Function, low: float, high: float, at_low: NDArray[np.float64], at_high: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Halve towards the larger change until nothing lies between, or until it proves smooth."""
    whole = np.abs(at_high - at_low).max()
    halvings = 0
    while whole > 0:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return low, high
        at_middle = function(middle)
        if np.abs(at_middle - at_low).max() >= np.abs(at_high - at_middle).max():
            high, at_high = middle, at_middle
        else:
            low, at_low = middle, at_middle
        halvings += 1
        if halvings >= HALVINGS and np.abs(at_high - at_low).max() < SHRINKAGE * whole:
            return None
    return None
