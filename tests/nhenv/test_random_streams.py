"""Random streams of rows: bit for bit NumPy's generator, which is the stranger in every test here."""

import inspect

import numpy as np
import pytest
from gymnasium.utils.seeding import np_random
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from nhenv import random_streams
from nhenv.random_streams import entropy_streams, generator, seed_streams, set_stream, uniform

EDGES = (*(2**bits - i for bits in (32, 63, 64, 96, 128, 160) for i in (0, 1)), 0, 1, 3**99)

words = st.integers(0, 2**64 - 1)


def _compiled():
    """`uniform` compiled as a generated module has it: from text, strict, with nothing but what the module exports."""
    decorator = '@njit(error_model="numpy")\n'
    constants = "".join(f"{name} = {getattr(random_streams, name)!r}\n" for name in random_streams.CONSTANTS)
    functions = [decorator + inspect.getsource(f).replace(": Array", "") for f in random_streams.SOURCES]
    module = {"njit": njit}
    exec("\n".join([random_streams.IMPORTS, constants, *functions]), module)
    return module["uniform"]


@pytest.fixture(scope="module", params=["interpreted", "compiled"])
def draw(request):
    """`uniform`, whose warnings pytest turns into errors if there are any."""
    return uniform if request.param == "interpreted" else _compiled()


def _seeded(seeds):
    streams = np.zeros((4, len(seeds)), np.uint64)
    seed_streams(streams, np.arange(len(seeds)), seeds)
    return streams


def _state(source):
    return source.bit_generator.state


# -- seeds -------------------------------------------------------------------------------------


@given(st.lists(st.one_of(words, st.integers(0, 2**32), st.integers(2**64, 2**160)), min_size=1, max_size=5))
@example(list(EDGES))
@settings(deadline=None)  # a pause of a busy machine is no fault
@example([2**63, 1])  # NumPy makes floats of these if it is not told otherwise
def test_a_seed_starts_the_stream_that_gymnasium_starts(seeds):
    streams = _seeded(seeds)
    for row, seed in enumerate(seeds):
        assert _state(generator(streams, row)) == _state(np_random(seed)[0])


@pytest.mark.parametrize("dtype", [np.uint64, np.int64, np.uint8, object])
def test_seeds_may_be_an_array_of_any_whole_numbers(dtype):
    seeds = np.arange(5, dtype=dtype)
    np.testing.assert_array_equal(_seeded(seeds), _seeded(range(5)))


def test_many_rows_are_seeded_each_with_its_own_seed_and_the_others_stay():
    count = 2 * random_streams.BLOCK + 3
    rng = np.random.default_rng(0)
    seeds, rows = rng.integers(0, 2**64, count, np.uint64), rng.permutation(2 * count)[:count]
    streams = np.full((4, 2 * count), 7, np.uint64)
    seed_streams(streams, rows, seeds)
    for i in (*range(0, count, 500), *(random_streams.BLOCK * k + d for k in (1, 2) for d in (-1, 0)), count - 1):
        assert _state(generator(streams, rows[i])) == _state(np_random(int(seeds[i]))[0])
    others = np.setdiff1d(np.arange(2 * count), rows)
    assert (streams[:, others] == 7).all()
    assert len(np.unique(streams[:, rows], axis=1).T) == count


@pytest.mark.parametrize(
    ("seeds", "error", "message"),
    [
        ([3, -1], ValueError, "negative, got -1"),
        (np.array([3, -1]), ValueError, "negative, got -1"),
        ([1.5, 2.0], TypeError, "float"),
        (np.array([1.5, 2.0]), TypeError, "float"),
        ([1, 2, 3], ValueError, r"got \(2,\) and \(3,\)"),
    ],
)
def test_what_is_no_seed_is_refused_and_changes_nothing(seeds, error, message):
    streams = np.zeros((4, 2), np.uint64)
    with pytest.raises(error, match=message):
        seed_streams(streams, [0, 1], seeds)
    assert not streams.any()


# -- entropy -----------------------------------------------------------------------------------


@given(st.one_of(st.integers(0, 2**128 - 1), st.integers(2**128, 2**200), st.integers(0, 2**33)))
@settings(max_examples=30, deadline=None)
def test_rows_from_entropy_are_the_children_of_a_seed_sequence(entropy):
    streams = np.zeros((4, 6), np.uint64)
    rows = [4, 0, 5]
    entropy_streams(streams, rows, entropy)
    for row, child in zip(rows, np.random.SeedSequence(entropy).spawn(3), strict=True):
        assert _state(generator(streams, row)) == np.random.PCG64(child).state
    assert not streams[:, [1, 2, 3]].any()


def test_rows_across_blocks_are_different_children():
    count = 2 * random_streams.BLOCK + 3
    streams = np.zeros((4, count), np.uint64)
    entropy_streams(streams, np.arange(count), 5)
    last = np.random.SeedSequence(5, spawn_key=(count - 1,))
    assert _state(generator(streams, count - 1)) == np.random.PCG64(last).state
    assert len(np.unique(streams, axis=1).T) == count


def test_entropy_is_fresh_at_every_call():
    streams = np.zeros((4, 3), np.uint64)
    entropy_streams(streams, np.arange(3))
    before = streams.copy()
    entropy_streams(streams, np.arange(3))
    assert (streams != before).all()  # two equal words of 64 bits are a chance of 1e-18


# -- draws -------------------------------------------------------------------------------------


def test_draws_are_those_of_numpy(draw):
    rng = np.random.default_rng(1)
    seeds = [*EDGES, *map(int, rng.integers(0, 2**64, 20, np.uint64))]
    streams = _seeded(seeds)
    for row, seed in enumerate(seeds):
        alone = np_random(seed)[0]
        assert [draw(streams, row) for _ in range(100)] == [alone.random() for _ in range(100)]
        assert _state(generator(streams, row)) == _state(alone)


@given(state=st.tuples(words, words, words, words))
@example(state=(2**64 - 1,) * 4)
@example(state=(0, 0, 0, 1))
@example(state=(0, 2**64 - 1, 0, 2**64 - 1))
@settings(deadline=None)  # the first one compiles
def test_a_draw_from_any_state_is_that_of_numpy(draw, state):
    streams = np.array(state, np.uint64)[:, None]
    streams[3] |= np.uint64(1)  # every increment is odd
    alone = generator(streams, 0)
    for _ in range(3):
        assert draw(streams, 0) == alone.random()
    assert _state(generator(streams, 0)) == _state(alone)


def test_a_draw_is_a_float_of_the_half_open_unit_interval(draw):
    streams = _seeded([3])
    draws = np.array([draw(streams, 0) for _ in range(2000)])
    assert isinstance(draw(streams, 0), float)
    assert 0.0 <= draws.min() < 0.01 < 0.99 < draws.max() < 1.0


def test_a_row_draws_the_same_whatever_other_rows_draw(draw):
    """Rows drawn from in a random order; each continues its own stream, and one never drawn from stays."""
    streams, order = _seeded(range(10, 15)), np.random.default_rng(2).integers(0, 4, 200).tolist()
    alone = [np_random(seed)[0] for seed in range(10, 15)]
    assert [draw(streams, row) for row in order] == [alone[row].random() for row in order]
    np.testing.assert_array_equal(streams[:, 4], _seeded([14])[:, 0])


def test_interpreted_many_rows_draw_at_once_what_they_draw_alone():
    streams, alone, rows = _seeded(range(20)), _seeded(range(20)), np.arange(1, 20, 2)
    for _ in range(10):
        np.testing.assert_array_equal(uniform(streams, rows), [uniform(alone, row) for row in rows])
    np.testing.assert_array_equal(streams, alone)


@given(seed=words, low=st.floats(-1e300, 1e300), width=st.floats(0, 1e300))
@example(seed=0, low=-0.1, width=0.2)
@settings(deadline=None)  # the first one compiles
def test_numpy_scales_a_draw_as_the_streams_do(draw, seed, low, width):
    """NumPy's uniform(low, high) is low + (high - low) * draw, rounded twice; one call for many is many calls."""
    streams, alone, high = _seeded([seed]), np_random(seed)[0], low + width
    assert low + (high - low) * draw(streams, 0) == alone.uniform(low, high)
    assert [low + (high - low) * draw(streams, 0) for _ in range(3)] == alone.uniform(low, high, 3).tolist()
    assert _state(generator(streams, 0)) == _state(alone)


# -- NumPy's generator -------------------------------------------------------------------------


def test_a_generator_leaves_its_row_until_it_is_put_back(draw):
    streams = _seeded([8, 9])
    before = streams.copy()
    source = generator(streams, 1)
    drawn = source.normal(size=5)
    np.testing.assert_array_equal(streams, before)
    set_stream(streams, 1, source)
    alone = np_random(9)[0]
    np.testing.assert_array_equal(drawn, alone.normal(size=5))
    assert [draw(streams, 1) for _ in range(5)] == alone.random(5).tolist()
    np.testing.assert_array_equal(streams[:, 0], before[:, 0])


def test_half_a_word_that_numpy_keeps_does_not_change_what_is_drawn(draw):
    streams, source = _seeded([0]), np_random(4)[0]
    source.integers(0, 10, dtype=np.uint32)
    assert _state(source)["has_uint32"] == 1
    set_stream(streams, 0, source)
    assert _state(generator(streams, 0))["has_uint32"] == 0
    assert [draw(streams, 0) for _ in range(5)] == source.random(5).tolist()


@pytest.mark.parametrize("kind", [np.random.Philox, np.random.PCG64DXSM])
def test_a_generator_of_another_kind_is_refused(kind):
    streams = _seeded([1])
    before = streams.copy()
    with pytest.raises(TypeError, match=f"PCG64, got {kind.__name__}"):
        set_stream(streams, 0, np.random.Generator(kind(1)))
    np.testing.assert_array_equal(streams, before)
