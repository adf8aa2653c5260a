"""Differential evolution, each generation judged at once, with a budget that is spent to the end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, differential_evolution

__all__ = ["evolve"]

Array = NDArray[np.float64]


def evolve(loss: Callable[[Array], Array], bounds: Bounds, *, population: int, generations: int, seed: int) -> Array:
    """The best vector (p,) that is found.

    Args:
        loss: vectors (p, S) -> what is to be small, shape (S,). It is called `generations` + 1 times, unless all
            vectors of a generation come out the same.
        bounds: smallest and largest values, shape (p,) each.
        population: vectors of a generation, rounded down to a multiple of p; at least p, and at least 5.
        generations: how many follow the random first one.
        seed: of all that is random.
    """
    result = differential_evolution(
        loss,  # type: ignore[arg-type]  # the stubs forget that a vectorized function returns an array
        bounds,
        popsize=max(1, population // len(bounds.lb)),
        maxiter=generations,
        rng=np.random.default_rng(seed),
        vectorized=True,
        updating="deferred",
        polish=False,
        tol=0,
    )
    return result.x
