import numpy as np
import pytest
from scipy.optimize import Bounds

from training.evolution import evolve

BOUNDS = Bounds(np.tile([-2.0, 0.0, -1.0], 2), np.tile([2.0, 4.0, 1.0], 2))
PLACE = np.tile([0.3, 1.7, 1.5], 2)  # every third beyond its bounds


def bowl(vectors):
    """Squared distance from `PLACE`."""
    return ((vectors - PLACE[:, None]) ** 2).sum(axis=0)


def test_it_finds_the_best_within_the_bounds():
    best = evolve(bowl, BOUNDS, population=60, generations=100, seed=0)
    assert best == pytest.approx([0.3, 1.7, 1.0] * 2, abs=1e-2)


@pytest.mark.parametrize(("population", "size"), [(30, 30), (32, 30), (2, 6)])
def test_the_budget_is_spent_to_the_end(population, size):
    """A generation that is nearly all alike ends nothing."""
    shapes = []

    def nearly_flat(vectors):
        shapes.append(vectors.shape)
        return 1.0 + 1e-9 * bowl(vectors)

    evolve(nearly_flat, BOUNDS, population=population, generations=7, seed=0)
    assert shapes == [(6, size)] * 8


def test_a_seed_is_a_search():
    first, again, other = (evolve(bowl, BOUNDS, population=15, generations=3, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
