"""What is said of several runs of many episodes: interquartile means, their bootstrap intervals, times to pass a mark.

Scores have the shape (runs, episodes). Runs are what is repeated; the episodes of a run share its luck. So
an interval comes from resampling runs and, within each run that was drawn, its episodes. (Agarwal et al.,
*Deep reinforcement learning at the edge of the statistical precipice*, 2021, resample runs within their task in
the same way.) To resample all episodes alike would be to take a hundred starts of one run for a hundred runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

__all__ = ["CONFIDENCE", "STATISTICS", "interval", "median_run", "seconds_to_pass", "summary"]

Array = NDArray[np.float64]

# What scores are reduced to: a function of values (..., n) and the axis to reduce.
STATISTICS: dict[str, Callable[..., Any]] = {
    "interquartile mean": partial(trim_mean, proportiontocut=0.25),
    "mean": np.mean,  # for what is 0 or 1: without its quarters, 80 % of successes would be all of them
}

CONFIDENCE = 0.95
RESAMPLES = 2000
_AT_ONCE = 1_000_000  # values that are resampled at once, to bound the memory


def interval(scores: Array, statistic: str = "interquartile mean", seed: int = 0) -> tuple[float, float]:
    """Ends of the interval that holds 95 % of a statistic's values over resampled scores.

    Args:
        scores: shape (runs, episodes).
        statistic: one of `STATISTICS`, over runs and episodes together.
        seed: seed of the resampling.
    """
    rng = np.random.default_rng(seed)
    runs, episodes = scores.shape
    block = max(1, _AT_ONCE // scores.size)
    values = []
    for start in range(0, RESAMPLES, block):
        count = min(block, RESAMPLES - start)
        run = rng.integers(runs, size=(count, runs, 1))
        episode = rng.integers(episodes, size=(count, runs, episodes))
        values.append(STATISTICS[statistic](scores[run, episode].reshape(count, -1), axis=1))
    low, high = np.quantile(np.concatenate(values), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def summary(scores: ArrayLike, statistic: str = "interquartile mean") -> dict[str, float]:
    """A statistic of scores (episodes,) or (runs, episodes) with its interval, and what else describes them all."""
    values = np.atleast_2d(np.asarray(scores, dtype=float))
    low, high = interval(values, statistic)
    return {
        "estimate": float(STATISTICS[statistic](values.ravel(), axis=0)),
        "low": low,
        "high": high,
        "mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "min": float(np.min(values)),
        "max": float(np.max(values)),
    }


def median_run(estimates: Sequence[float], better: int) -> int:
    """Index of the run in the middle; of the two that are there of an even number, the worse one.

    Args:
        estimates: one for each run.
        better: +1 if more is better, -1 if less is.
    """
    from_worst = np.argsort(better * np.asarray(estimates), kind="stable")
    return int(from_worst[(len(estimates) - 1) // 2])


def seconds_to_pass(
    curves: Sequence[Sequence[Mapping[str, Any]]], metric: str, mark: float, better: int
) -> float | None:
    """CPU seconds after which a run first does better than `mark`, in the median over runs; None if most never do.

    Args:
        curves: learning curve of each run, whose points have "cpu_s" and the metric.
        metric: key of the points.
        mark: what is to be passed.
        better: +1 if more is better, -1 if less is.
    """
    first = [
        next((point["cpu_s"] for point in curve if better * point[metric] > better * mark), np.inf) for curve in curves
    ]
    median = float(np.median(first))
    return median if np.isfinite(median) else None
