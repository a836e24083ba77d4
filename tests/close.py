"""``values == pytest.approx(expected)`` for arrays of many numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest


def assert_close(
    values: Any, expected: Any, *, rel: float | None = None, abs: float | None = None
) -> None:
    """Assert ``values == pytest.approx(expected, rel, abs)``.

    pytest compares two arrays number by number in Python: seconds for a matrix of the size of the
    information. It is asked where the arrays are not close, which it explains, and where their
    shapes differ or a number is not finite.
    """
    values, expected = np.asarray(values), np.asarray(expected)
    if values.shape != expected.shape or not _within(values, expected, rel, abs):
        assert values == pytest.approx(expected, rel=rel, abs=abs)


def _within(
    values: np.ndarray, expected: np.ndarray, rel: float | None, absolute: float | None
) -> bool:
    """Tell whether no difference exceeds the tolerance that pytest grants to its number."""
    tolerance: Any = 1e-12 if absolute is None else absolute
    if rel is not None or absolute is None:
        tolerance = np.maximum(tolerance, (1e-6 if rel is None else rel) * np.abs(expected))
    with np.errstate(invalid="ignore"):
        difference = np.abs(values - expected)
    return bool(np.isfinite(difference).all() and (difference <= tolerance).all())
