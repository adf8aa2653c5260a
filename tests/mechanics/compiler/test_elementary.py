"""The arithmetic of generated kernels, against fifty digits and against itself in vectors."""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from mechanics.compiler import elementary
from mechanics.compiler.elementary import align_stack, clip, cos, either, fma, sign, sin

# Half a unit in the last place of 1 for the polynomial's last addition, as much for the rounded remainder of the
# reduction, and some for the terms before.
SINE_ERROR = 2.6e-16


@njit(error_model="numpy")
def sines(x, out):
    for i in range(len(x)):
        out[0, i], out[1, i] = sin(x[i]), cos(x[i])


@njit(error_model="numpy")
def fused(a, b, c):
    return fma(a, b, c)


@njit(error_model="numpy")
def others(x, low, high):
    align_stack()
    return clip(x, low, high), either(x, low), sign(x)


@pytest.mark.parametrize("size", [1e-8, 1.0, 1e2, 1e5, 1e9, 1e12])
def test_sine_and_cosine_in_fifty_digits(size):
    x = np.random.default_rng(3).uniform(-size, size, 2000)
    ours = np.empty((2, len(x)))
    sines(x, ours)
    with mpmath.workdps(50):
        for function, values in zip((mpmath.sin, mpmath.cos), ours, strict=True):
            errors = [
                abs(function(mpmath.mpf(a)) - mpmath.mpf(b)) for a, b in zip(x.tolist(), values.tolist(), strict=True)
            ]
            assert max(errors) < SINE_ERROR


def test_sine_and_cosine_near_their_zeros_and_extremes():
    """Where a quadrant ends, a reduction that is not exact would show."""
    x = np.array([s * n * math.pi / 4 + d for n in range(400) for d in (-1e-9, 0.0, 1e-9) for s in (-1, 1)])
    ours = np.empty((2, len(x)))
    sines(x, ours)
    with mpmath.workdps(50):
        exact = [[float(f(mpmath.mpf(v))) for v in x.tolist()] for f in (mpmath.sin, mpmath.cos)]
    np.testing.assert_allclose(ours, exact, rtol=0, atol=SINE_ERROR)


def test_what_is_not_a_number_stays_so():
    ours = np.empty((2, 3))
    sines(np.array([np.nan, np.inf, -np.inf]), ours)
    assert np.isnan(ours).all()
    clipped, chosen, signed = others(np.nan, -1.0, 1.0)
    assert np.isnan(clipped)
    assert chosen == -1.0
    assert np.isnan(signed)


def test_vectors_have_the_bits_of_scalars():
    """Any number of rows, whole vectors and remainders alike."""
    x = np.random.default_rng(4).uniform(-50, 50, 203)
    together, alone = np.empty((2, len(x))), np.empty((2, len(x)))
    sines(x, together)
    for i in range(len(x)):
        sines(x[i : i + 1], alone[:, i : i + 1])
    assert together.tobytes() == alone.tobytes()


@given(*[st.floats(-1e100, 1e100, allow_subnormal=False)] * 3)
@settings(deadline=None)
def test_fma_rounds_once(a, b, c):
    with mpmath.workdps(700):
        exact = float(mpmath.mpf(a) * mpmath.mpf(b) + mpmath.mpf(c))
    assert fused(a, b, c) == exact


@pytest.mark.parametrize(
    ("x", "clipped", "signed"), [(-3.0, -1.0, -1.0), (0.25, 0.25, 1.0), (7.0, 1.0, 1.0), (0.0, 0.0, 0.0)]
)
def test_clip_either_sign(x, clipped, signed):
    assert others(x, -1.0, 1.0) == (clipped, x, signed)


def test_everything_public_is_tried_here():
    assert set(elementary.__all__) == {"align_stack", "clip", "cos", "either", "fma", "sign", "sin"}
