from __future__ import annotations

import math

import numpy as np
import pytest

from dopt.kernel.network import tanh


def test_tanh_is_right_to_a_few_units_in_the_last_place() -> None:
    rng = np.random.default_rng(0)
    sizes = np.concatenate(
        [
            10.0 ** rng.uniform(-320, 3, 4_000),
            rng.uniform(0.0, 25.0, 8_000),
            rng.uniform(0, 1, 8_000),
        ]
    )
    exact = np.array([math.tanh(x) for x in sizes])
    found = np.array([tanh(x) for x in sizes])
    assert np.abs(found - exact).max() <= 2 * np.spacing(1.0)
    assert np.all(np.abs(found - exact) <= 6 * np.spacing(exact))
    assert np.all(found <= 1.0)


def test_tanh_is_odd() -> None:
    for x in np.random.default_rng(1).standard_normal(200) * 5:
        assert tanh(-x) == -tanh(x)


@pytest.mark.parametrize(
    "x", [0.0, -0.0, 5e-324, 1e-310, 1e-30, 19.99, 20.0, 20.01, 1e308, math.inf]
)
def test_tanh_at_the_edges(x: float) -> None:
    assert tanh(x) == pytest.approx(math.tanh(x), rel=1e-15)
    assert tanh(-x) == pytest.approx(math.tanh(-x), rel=1e-15)


def test_tanh_of_nan_is_nan() -> None:
    assert math.isnan(tanh(math.nan))


def test_tanh_never_falls() -> None:
    x = np.linspace(-1e-3, 1e-3, 2_001)
    for start in (0.0, 0.34, 0.35, 1.0, 5.0, 19.0):
        values = np.array([tanh(start + dx) for dx in x])
        assert np.all(np.diff(values) >= -2 * np.spacing(1.0))
