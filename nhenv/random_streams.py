"""A random stream for each row of a vector environment, without a Python object for each.

Row r of `streams`, an array of shape (4, N), is a PCG64 generator: the high and the low half of
its state, the high and the low half of its increment. Seeded with s, it draws bit for bit what
`numpy.random.Generator(PCG64(SeedSequence(s)))` draws, which is what Gymnasium gives an
environment that is reset with the seed s. Its `uniform(low, high)` is then low + (high - low) * `uniform(streams, r)`.

The functions in SOURCES are taken in whole by generated kernels: plain Python that runs compiled or
not. Integers are explicitly unsigned, because Numba makes a float of a signed and an unsigned one;
`add` and `multiply` wrap around without the warning of NumPy's operators between scalars.

References:
    M. E. O'Neill, "PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms for
    Random Number Generation", Harvey Mudd College HMC-CS-2014-0905, 2014: XSL RR 128/64.
    M. E. O'Neill, "Developing a seed_seq Alternative", 2015: the hash behind `SeedSequence`.
"""

import operator
import secrets
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy import add, multiply, uint64

__all__ = [
    "CONSTANTS",
    "IMPORTS",
    "SOURCES",
    "entropy_streams",
    "generator",
    "next_state",
    "seed_streams",
    "set_stream",
    "uniform",
]

Array = Any  # NumPy array or scalar, or Numba's view of one

IMPORTS = "from numpy import add, multiply, uint64\n"  # what a module that contains SOURCES needs

MULTIPLIER_HIGH = 0x2360ED051FC65DA4  # of PCG64's 128-bit congruential generator
MULTIPLIER_LOW = 0x4385DF649FCCF645
LOW_HALF = 0xFFFFFFFF
ULP = 2.0**-53  # doubles in [0, 1) are drawn as multiples of it

CONSTANTS = ("MULTIPLIER_HIGH", "MULTIPLIER_LOW", "LOW_HALF", "ULP")


def next_state(high: Array, low: Array, increment_high: Array, increment_low: Array) -> "tuple[Array, Array]":
    """State of PCG64 after this one: state * multiplier + increment modulo 2**128, in halves of 64 bits."""
    half, mask = uint64(32), uint64(LOW_HALF)
    # All 128 bits of low * MULTIPLIER_LOW, from products of 32-bit digits; `middle` has room for its carries.
    m1, m0 = uint64(MULTIPLIER_LOW >> 32), uint64(MULTIPLIER_LOW & LOW_HALF)
    d1, d0 = low >> half, low & mask
    first, second = multiply(d1, m0), multiply(d0, m1)
    middle = add(multiply(d0, m0) >> half, add(first & mask, second & mask))
    carried = add(add(first >> half, second >> half), middle >> half)
    product_high = add(multiply(d1, m1), carried)
    # Of the other two products only the low halves stay below 2**128.
    product_high = add(product_high, multiply(high, uint64(MULTIPLIER_LOW)))
    product_high = add(product_high, multiply(low, uint64(MULTIPLIER_HIGH)))
    new_low = add(multiply(low, uint64(MULTIPLIER_LOW)), increment_low)
    carry = uint64(new_low < increment_low)
    return add(add(product_high, increment_high), carry), new_low


def uniform(streams: Array, row: Array) -> float:
    """Advance a row's stream by one draw, and return that number of [0, 1), as `Generator.random()` does.

    Interpreted, `row` may also be an array of distinct rows, and the draws are then one too.
    """
    high, low = next_state(streams[0, row], streams[1, row], streams[2, row], streams[3, row])
    streams[0, row] = high
    streams[1, row] = low
    # The halves folded together, rotated right by the uppermost six bits; a shift by 64 would be undefined.
    turn, word = high >> uint64(58), high ^ low
    word = (word >> turn) | (word << ((uint64(64) - turn) & uint64(63)))
    return (word >> uint64(11)) * ULP


# In the order in which a module that contains them defines them.
SOURCES = (next_state, uniform)


BLOCK = 8192  # rows hashed at a time, so that intermediate results stay in the cache

# Of SeedSequence: starts and factors of its two sequences of hash constants, and the factors of its mixing.
POOL_START, POOL_FACTOR = 0x43B0D7E5, 0x931E8875
OUTPUT_START, OUTPUT_FACTOR = 0x8B51F9DD, 0x58F38DED
MIX_LEFT, MIX_RIGHT = 0xCA01F9DD, 0x4973F715
POOL_SIZE = 4  # words of 32 bits


def seed_streams(streams: Array, rows: Array, seeds: Sequence[int] | Array) -> None:
    """Start the streams of some rows from seeds, as `PCG64(SeedSequence(seed))` starts.

    Args:
        streams: shape (4, N), uint64.
        rows: indices, shape (n,).
        seeds: n whole numbers, none negative; those from 2**128 on take NumPy some microseconds each.
    """
    rows, (words, large) = np.asarray(rows), _seed_words(seeds)
    if rows.shape != words[0].shape:
        raise ValueError(f"rows and seeds must have the same shape (n,), got {rows.shape} and {words[0].shape}")
    for start in range(0, len(rows), BLOCK):
        block = slice(start, start + BLOCK)
        streams[:, rows[block]] = _streams([word[block] for word in words])
    for place, seed in large.items():
        set_stream(streams, rows[place], np.random.Generator(np.random.PCG64(seed)))


def entropy_streams(streams: Array, rows: Array, entropy: int | None = None) -> None:
    """Start the streams of some rows from the same entropy, as from the n children of `SeedSequence(entropy)`.

    Args:
        streams: shape (4, N), uint64.
        rows: indices, shape (n,).
        entropy: not negative, at best of 128 bits; None for fresh entropy from the operating system.
    """
    rows, entropy = np.asarray(rows), secrets.randbits(128) if entropy is None else entropy
    shared = [np.array([word], np.uint32) for word in _digits(entropy)]
    for start in range(0, len(rows), BLOCK):
        some = rows[start : start + BLOCK]
        streams[:, some] = _streams([*shared, np.arange(start, start + len(some), dtype=np.uint32)])


def generator(streams: Array, row: int) -> np.random.Generator:
    """NumPy's generator in the state of a row's stream; what it draws leaves the row as it is."""
    state_high, state_low, increment_high, increment_low = streams[:, row].tolist()
    bits = np.random.PCG64(0)
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": increment_high << 64 | increment_low},
        "has_uint32": 0,
        "uinteger": 0,
    }
    return np.random.Generator(bits)


def set_stream(streams: Array, row: int, source: np.random.Generator) -> None:
    """Put a row's stream in the state of a generator.

    Half a word that the generator keeps after drawing 32 bits is lost: a stream draws whole words.
    """
    state = source.bit_generator.state
    if state["bit_generator"] != "PCG64":
        raise TypeError(f"a row's generator must run on PCG64, got {state['bit_generator']}: make it from PCG64(seed)")
    words = (state["state"]["state"], state["state"]["inc"])
    streams[:, row] = np.array([half for word in words for half in divmod(word, 2**64)], np.uint64)


def _seed_words(seeds: Sequence[int] | Array) -> tuple[list[Array], dict[int, int]]:
    """Seeds as arrays of words of 32 bits, lowest first; and by place those that need more words than the pool has."""
    if isinstance(seeds, np.ndarray) and seeds.dtype.kind == "u":
        return _split(seeds.astype(np.uint64)), {}
    # NumPy would round a float, and makes floats of a list of small and large integers.
    whole = [operator.index(seed) for seed in (seeds.tolist() if isinstance(seeds, np.ndarray) else seeds)]
    lowest, highest = min(whole, default=0), max(whole, default=0)
    if lowest < 0:
        raise ValueError(f"seeds must not be negative, got {lowest}")
    if highest < 2**64:
        return _split(np.array(whole, np.uint64)), {}
    # Words of zeros change nothing, as the pool is filled up with them.
    large = {place: seed for place, seed in enumerate(whole) if seed >> 128}
    halves = ([seed >> shift & 0xFFFFFFFFFFFFFFFF for seed in whole] for shift in (0, 64))
    return [word for half in halves for word in _split(np.array(half, np.uint64))], large


def _split(numbers: Array) -> list[Array]:
    """The low and the high 32 bits of numbers of 64."""
    return [(numbers & LOW_HALF).astype(np.uint32), (numbers >> 32).astype(np.uint32)]


def _digits(entropy: int) -> list[int]:
    """Entropy as SeedSequence reads it before a spawn key: words of 32 bits, lowest first, no fewer than the pool."""
    count = max(POOL_SIZE, -(-entropy.bit_length() // 32))
    return [entropy >> 32 * i & LOW_HALF for i in range(count)]


def _streams(words: list[Array]) -> list[Array]:
    """Columns of `streams` seeded with words of 32 bits, lowest first; each word an array, one element a row or one."""
    half = _output(_pool(words))
    state_high, state_low, sequence_high, sequence_low = (
        half[i].astype(np.uint64) | half[i + 1].astype(np.uint64) << 32 for i in range(0, 8, 2)
    )
    # Increments are odd. The first step, from a state of 0, has led to the increment itself; the seed is added.
    increment_high, increment_low = sequence_high << 1 | sequence_low >> 63, sequence_low << 1 | 1
    low = increment_low + state_low
    high = increment_high + state_high + (low < state_low)
    return [*next_state(high, low, increment_high, increment_low), increment_high, increment_low]


def _pool(words: list[Array]) -> list[Array]:
    """SeedSequence's pool: the words hashed, each mixed with all others, then with what did not fit."""
    constants = _constants(POOL_START, POOL_FACTOR)
    nothing = np.zeros(1, np.uint32)
    padded = [*words, *[nothing] * (POOL_SIZE - len(words))]
    pool = [_hash(word, constants) for word in padded[:POOL_SIZE]]
    for i in range(POOL_SIZE):
        for j in range(POOL_SIZE):
            if i != j:
                pool[j] = _mix(pool[j], _hash(pool[i], constants))
    for word in padded[POOL_SIZE:]:
        pool = [_mix(pooled, _hash(word, constants)) for pooled in pool]
    return pool


def _output(pool: list[Array]) -> list[Array]:
    """Eight words of 32 bits from the pool."""
    constants = _constants(OUTPUT_START, OUTPUT_FACTOR)
    return [_hash(pool[i % POOL_SIZE], constants) for i in range(8)]


def _hash(word: Array, constants: Iterator[tuple[int, int]]) -> Array:
    before, after = next(constants)
    word = (word ^ before) * after
    return word ^ word >> 16


def _mix(left: Array, right: Array) -> Array:
    word = left * MIX_LEFT - right * MIX_RIGHT
    return word ^ word >> 16


def _constants(start: int, factor: int) -> Iterator[tuple[int, int]]:
    """Each of a sequence of hash constants with the next."""
    while True:
        following = start * factor & LOW_HALF
        yield start, following
        start = following
