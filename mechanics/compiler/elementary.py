"""Arithmetic that generated kernels are made of: the same bits for one row, for many, and on any machine.

Compilers may contract a*b + c, or call another sine for vectors than for scalars; then an environment
alone and the same one as a row of many drift apart. Here every rounding is spelled out: products are
fused with additions where `fma` says so and nowhere else, and sine and cosine are polynomials without
branches, which LLVM turns into vector code that rounds as the scalar code does.

Sine and cosine are right to 2.5e-16 for |x| < 1e12, where the argument itself is uncertain by 1e-4.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

__all__ = ["align_stack", "clip", "cos", "either", "fma", "sign", "sin"]

_inline = njit(error_model="numpy", forceinline=True)

# x + _SHIFT has the nearest whole number to x in its lowest bits, for |x| < 2**51.
_SHIFT = 1.5 * 2.0**52
# As a double, pi ends in three zero bits, so the first step of the reduction is exact.
_PI, _PI_REST = 3.141592653589793, 1.2246467991473532e-16
_ONE_OVER_PI = 0.3183098861837907
_SIGN_BIT = np.uint64(63)


def _fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        double = ir.DoubleType()
        operation = builder.module.declare_intrinsic("llvm.fma", [double], ir.FunctionType(double, [double] * 3))
        return builder.call(operation, arguments)

    return types.float64(types.float64, types.float64, types.float64), build


def _cast(typing_context: Any, x: Any) -> Any:
    from_float = x == types.float64

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64) if from_float else ir.DoubleType())

    return types.uint64(types.float64) if from_float else types.float64(types.uint64), build


def _align_stack(typing_context: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = builder.alloca(ir.ArrayType(ir.DoubleType(), 8))
        place.align = 64
        builder.asm(ir.FunctionType(ir.VoidType(), [place.type]), "", "r", [place], True)
        return context.get_dummy_value()

    return types.void(), build


fma: Any = intrinsic(_fma)
"""a*b + c with one rounding."""

align_stack: Any = intrinsic(_align_stack)
"""Have the stack frame of a function begin at a cache line.

Vectors that do not fit into the registers are kept there, and LLVM aligns the frame for the widest variable that it
knows of before it makes these places. Without it, many of them straddle two lines.
"""

# The 64 bits of a float, and the float that has these bits.
_bits: Any = intrinsic(_cast)


@_inline
def _half_turns(x: float) -> float:
    """A float whose lowest bits are the nearest whole number to x/pi."""
    return fma(x, _ONE_OVER_PI, _SHIFT)


@_inline
def _rest(x: float, shifted: float) -> float:
    """X without its half turns, in [-pi/2, pi/2]."""
    turns = shifted - _SHIFT
    return fma(-turns, _PI_REST, fma(-turns, _PI, x))


@_inline
def _flip(shifted: float, value: float) -> float:
    """The value, its sign changed if the number of half turns is odd."""
    return _bits(_bits(value) ^ (_bits(shifted) << _SIGN_BIT))


# Polynomials through Chebyshev nodes, found in 50 digits: sin r = r + r z p(z) to 1e-18 and
# cos r = 1 - z/2 + z**2 q(z) to 6e-17, for z = r**2 and |r| <= pi/2. Over a quarter turn they could be shorter,
# but then sine and cosine have to be exchanged, which costs more.


@_inline
def sin(x: float) -> float:
    """Sine."""
    shifted = _half_turns(x)
    r = _rest(x, shifted)
    z = r * r
    p = fma(z, 2.7314446164953908e-15, -7.643970284729239e-13)
    p = fma(z, p, 1.6058977312086063e-10)
    p = fma(z, p, -2.5052107616990352e-08)
    p = fma(z, p, 2.7557319219163188e-06)
    p = fma(z, p, -0.00019841269841254974)
    p = fma(z, p, 0.008333333333333316)
    p = fma(z, p, -0.16666666666666666)
    return _flip(shifted, fma(r * z, p, r))


@_inline
def cos(x: float) -> float:
    """Cosine; with `sin` of the same x, the compiler does what they share once."""
    shifted = _half_turns(x)
    r = _rest(x, shifted)
    z = r * r
    q = fma(z, 4.6464357088429486e-14, -1.1466252242734278e-11)
    q = fma(z, q, 2.087668155843873e-09)
    q = fma(z, q, -2.7557318573361236e-07)
    q = fma(z, q, 2.4801587298913527e-05)
    q = fma(z, q, -0.0013888888888884767)
    q = fma(z, q, 0.04166666666666666)
    return _flip(shifted, fma(z * z, q, fma(z, -0.5, 1.0)))


@_inline
def clip(x: float, low: float, high: float) -> float:
    """The nearest number to x in [low, high]; not a number stays so."""
    x = low if x < low else x
    return high if x > high else x


@_inline
def either(given: float, otherwise: float) -> float:
    """What is given, unless it is not a number."""
    return otherwise if given != given else given


@_inline
def sign(x: float) -> float:
    """1, -1 or 0; not a number stays so."""
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else x)
