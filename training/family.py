"""`Family`: controllers of one kind for one environment, each of them a vector of parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds

from training.rollout import Controller

__all__ = ["Family"]


@dataclass(frozen=True)
class Family:
    """Controllers that can be tuned.

    Attributes:
        ranges: parameter -> smallest and largest value of a search, in the order of a vector.
        controller: makes a controller of a vector (p,), or of one vector an episode, (N, p).
    """

    ranges: Mapping[str, tuple[float, float]]
    controller: Callable[[NDArray[np.float64]], Controller]

    @property
    def bounds(self) -> Bounds:
        """The ranges as SciPy wants them."""
        return Bounds(*np.transpose([*self.ranges.values()]))
