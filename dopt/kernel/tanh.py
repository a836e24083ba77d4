"""Hyperbolic tangent that the compiler turns into vector instructions, in both precisions.

tanh x = -e/(2 + e), e = exp(-2|x|) - 1, with the sign of x. exp is 2^k (1 + p(r)) with
r = -2|x| - k ln 2, |r| ≤ ln 2 / 2, and p the Taylor polynomial of exp(r) - 1. The relative error is
a few units in the last place everywhere; NaN stays NaN.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numba.extending import overload

from dopt.kernel.compiler import contracted, power_of_two
from dopt.types import NumbaType, Scalar

# Double precision. Adding 1.5 * 2^52 leaves the nearest integer in the low bits; the high part of
# ln 2 ends in zeros, so that its product with k is exact.
LOG2_E = 1.4426950408889634
LN2_HIGH = 6.93147180369123816490e-01
LN2_LOW = 1.90821492927058770002e-10
ROUND = 6755399441055744.0
SATURATION = 20.0
C = tuple(1.0 / math.factorial(n) for n in range(14))

# The same in single precision.
LOG2_E_SINGLE = np.float32(LOG2_E)
LN2_HIGH_SINGLE = np.float32(0.693359375)
LN2_LOW_SINGLE = np.float32(-2.12194440e-4)
ROUND_SINGLE = np.float32(12582912.0)
SATURATION_SINGLE = np.float32(10.0)
C_SINGLE = tuple(np.float32(c) for c in C[:9])
ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


def tanh(x: Scalar) -> Scalar:
    """Return tanh x in the precision of x."""
    return _tanh_single(x) if isinstance(x, np.float32) else _tanh_double(x)


@overload(tanh, strict=False)
def _tanh(x: NumbaType) -> NumbaType:
    if x == types.float32:
        return lambda x: _tanh_single(x)
    return lambda x: _tanh_double(x)


@contracted
def _tanh_double(x: float) -> float:
    size = abs(x)
    size = SATURATION if size > SATURATION else size
    y = -2.0 * size
    shifted = y * LOG2_E + ROUND
    k = shifted - ROUND
    r = (y - k * LN2_HIGH) - k * LN2_LOW
    p = C[13]
    for n in (12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2):
        p = p * r + C[n]
    p = p * r * r + r
    power: float = power_of_two(shifted)
    e: float = power * p + (power - 1.0)
    value = -e / (2.0 + e)
    return value if x >= 0.0 else -value


@contracted
def _tanh_single(x: np.float32) -> np.float32:
    size = abs(x)
    size = SATURATION_SINGLE if size > SATURATION_SINGLE else size
    y = -TWO * size
    shifted = y * LOG2_E_SINGLE + ROUND_SINGLE
    k = shifted - ROUND_SINGLE
    r = (y - k * LN2_HIGH_SINGLE) - k * LN2_LOW_SINGLE
    p = C_SINGLE[8]
    for n in (7, 6, 5, 4, 3, 2):
        p = p * r + C_SINGLE[n]
    p = p * r * r + r
    power: np.float32 = power_of_two(shifted)
    e: np.float32 = power * p + (power - ONE)
    value: np.float32 = -e / (TWO + e)
    return value if x >= ZERO else -value
