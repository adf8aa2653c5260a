import numpy as np
import pytest
from scipy.stats import bootstrap

from training.statistics import STATISTICS, interval, median_run, seconds_to_pass, summary

# Values in general position, some far off: what means and interquartile means tell apart.
SCORES = np.random.default_rng(3).standard_cauchy((6, 20)) + np.arange(6)[:, None]


def middle_half(values):
    """Interquartile mean the long way round: sort, drop a quarter at each end, add up."""
    ordered = sorted(values)
    cut = len(ordered) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


def width_and_middle(ends):
    low, high = ends
    return high - low, (high + low) / 2


def test_interquartile_mean_is_that_of_the_middle_half():
    assert summary(SCORES)["estimate"] == pytest.approx(middle_half(SCORES.ravel()), rel=1e-12)
    assert summary([1.0, 2.0, 3.0, 1e6])["estimate"] == 2.5


@pytest.mark.parametrize("statistic", STATISTICS)
def test_interval_resamples_runs_and_then_episodes_of_each(statistic):
    function = {"interquartile mean": middle_half, "mean": np.mean}[statistic]
    rng = np.random.default_rng(7)
    values = []
    for _ in range(4000):
        drawn = []
        for run in rng.choice(len(SCORES), len(SCORES)):
            drawn += rng.choice(SCORES[run], SCORES.shape[1]).tolist()
        values.append(function(drawn))
    expected = np.quantile(values, [0.025, 0.975])
    # An end of an interval from 2000 resamples varies by some 3 % of the interval's width (seen over seeds).
    width = expected[1] - expected[0]
    np.testing.assert_allclose(interval(SCORES, statistic), expected, atol=0.1 * width)


# SciPy resamples one level: runs if each has one episode, episodes if there is one run.
@pytest.mark.parametrize("scores", [SCORES[:, :1], SCORES[:1]], ids=["runs", "episodes"])
def test_with_one_level_the_interval_is_that_of_scipy(scores):
    for name, statistic in STATISTICS.items():
        theirs = bootstrap(
            (scores.ravel(),), statistic, method="percentile", n_resamples=4000, vectorized=True, rng=1
        ).confidence_interval
        np.testing.assert_allclose(interval(scores, name), theirs, atol=0.1 * (theirs.high - theirs.low))


def test_many_starts_of_few_runs_are_no_more_runs():
    # Runs that differ, episodes that don't: more of them add nothing.
    apart = np.array([10.0, 20.0, 30.0])[:, None]
    few, many = (interval(np.repeat(apart, episodes, axis=1), "mean") for episodes in (1, 200))
    np.testing.assert_allclose(many, few, atol=1.0)
    assert many[1] - many[0] > 9


def test_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for trial in range(200):
        scores = rng.normal(0, 2, (10, 1)) + rng.normal(0, 1, (10, 5))
        low, high = interval(scores, seed=trial)
        hits += low <= 0 <= high
    # Percentile intervals of ten runs are known to be short: 0.9 instead of 0.95. Binomial error 0.02.
    assert 0.84 <= hits / 200 <= 0.97


def test_large_samples_are_resampled_in_blocks(monkeypatch):
    monkeypatch.setattr("training.statistics._AT_ONCE", 7 * SCORES.size)
    width, middle = width_and_middle(interval(SCORES))
    monkeypatch.undo()
    expected_width, expected_middle = width_and_middle(interval(SCORES))
    assert width == pytest.approx(expected_width, rel=0.15)
    assert middle == pytest.approx(expected_middle, abs=0.1 * expected_width)


def test_summary_describes_all_values():
    one = summary([[1.0, 2.0], [3.0, 6.0]])
    assert one.keys() == {"estimate", "low", "high", "mean", "std", "min", "max"}
    assert (one["mean"], one["min"], one["max"]) == (3.0, 1.0, 6.0)
    assert one["std"] == pytest.approx(np.sqrt(3.5))
    assert one["low"] <= one["estimate"] <= one["high"]
    assert summary([1.0, 1.0, 1.0, 0.0], "mean")["estimate"] == 0.75
    assert summary(SCORES) == summary(SCORES)


def test_what_is_not_a_number_stays_so():
    one = summary([1.0, float("nan"), 3.0, 4.0])
    assert np.isnan([one["estimate"], one["low"]]).all()


def test_median_run_is_never_the_better_of_two():
    assert median_run([3.0, 1.0, 2.0], +1) == 2
    assert median_run([3.0, 1.0, 2.0, 4.0], +1) == 2
    assert median_run([3.0, 1.0, 2.0, 4.0], -1) == 0
    assert median_run([5.0], -1) == 0


def test_seconds_to_pass_are_those_of_the_median_seed():
    def curve(*points):
        return [{"cpu_s": seconds, "m": value} for seconds, value in points]

    curves = [curve((1, 0.0), (2, 5.0), (3, 4.0)), curve((1, 0.0), (4, 4.5)), curve((1, 0.0), (9, 4.0))]
    assert seconds_to_pass(curves, "m", 4.0, +1) == 4.0
    assert seconds_to_pass(curves[:2], "m", 4.0, +1) == 3.0
    assert seconds_to_pass(curves, "m", 4.5, +1) is None  # one of three does
    assert seconds_to_pass(curves, "m", 1.0, -1) == 1.0
