"""Random points at which an algebra looks at its factors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mechanics.mechanism import Mechanism

__all__ = ["sample_points"]

POINTS = 200


def sample_points(mechanism: Mechanism, moving: Iterable[str]) -> dict[str, NDArray[np.float64]]:
    """Name -> [p] values at random points of the whole configuration space, always the same, as `Algebra` takes them.

    Args:
        mechanism: whose parameters and drag coefficients are near their defaults.
        moving: names of everything else, which may be any angle.
    """
    rng = np.random.default_rng(3)
    numbers = {**mechanism.parameters, **mechanism.drag}
    values = {name: value * rng.uniform(0.9, 1.1, POINTS) for name, value in numbers.items()}
    return values | {name: rng.uniform(-np.pi, np.pi, POINTS) for name in moving}
