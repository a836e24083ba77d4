"""Hyperbolic tangent that the compiler turns into vector instructions."""

from __future__ import annotations

from dopt.kernel.compiler import bits_from_float, contracted, float_from_bits

LOG2_E = 1.4426950408889634
LN2_HIGH = 6.93147180369123816490e-01
LN2_LOW = 1.90821492927058770002e-10
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it leaves the nearest integer in the low bits
SATURATION = 20.0


@contracted
def tanh(x: float) -> float:
    """Return tanh x = -e/(2 + e), e = exp(-2|x|) - 1, with the sign of x.

    exp is 2^k (1 + poly(r)) with r = -2|x| - k ln 2, |r| ≤ ln 2 / 2. The relative error is a few
    units in the last place everywhere; NaN stays NaN.
    """
    size = abs(x)
    size = SATURATION if size > SATURATION else size
    y = -2.0 * size
    shifted = y * LOG2_E + ROUND
    k = shifted - ROUND
    r = (y - k * LN2_HIGH) - k * LN2_LOW
    poly = 1.0 / 6227020800.0
    poly = poly * r + 1.0 / 479001600.0
    poly = poly * r + 1.0 / 39916800.0
    poly = poly * r + 1.0 / 3628800.0
    poly = poly * r + 1.0 / 362880.0
    poly = poly * r + 1.0 / 40320.0
    poly = poly * r + 1.0 / 5040.0
    poly = poly * r + 1.0 / 720.0
    poly = poly * r + 1.0 / 120.0
    poly = poly * r + 1.0 / 24.0
    poly = poly * r + 1.0 / 6.0
    poly = poly * r + 0.5
    poly = poly * r * r + r
    power: float = float_from_bits((bits_from_float(shifted) << 52) + (1023 << 52))
    e: float = power * poly + (power - 1.0)
    value = -e / (2.0 + e)
    return value if x >= 0.0 else -value
