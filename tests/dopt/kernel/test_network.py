"""Products of the network in compiled code."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from dopt.kernel.network import add_product


def sums_in_order(W: np.ndarray, x: np.ndarray, start: np.ndarray, fused: bool) -> list[float]:
    """Return start + W x, term after term, with products that are rounded or not."""
    sums = []
    for row, total in zip(W.tolist(), start.tolist(), strict=True):
        for weight, value in zip(row, x.tolist(), strict=True):
            product = Fraction(weight) * Fraction(value) if fused else Fraction(weight * value)
            total = float(Fraction(total) + product)
        sums.append(total)
    return sums


@pytest.mark.parametrize("n_out", range(1, 10))
@pytest.mark.parametrize("n_in", [1, 5, 16])
def test_each_sum_of_a_product_is_taken_in_order(n_out: int, n_in: int) -> None:
    """Bit for bit: the losses of stored trials depend on it."""
    rng = np.random.default_rng(n_out)
    W, x, out = rng.standard_normal((n_out, n_in)), rng.standard_normal(n_in), np.empty(n_out)
    start = rng.standard_normal(n_out)
    out[:] = start
    add_product(W, x, out)
    assert out.tolist() in [sums_in_order(W, x, start, fused) for fused in (True, False)]
