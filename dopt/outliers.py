"""Outliers of a measured signal: values that are far from most of those around them."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dopt.types import Array, Booleans

NEAR, MOST_OUTLIERS = 31, 0.02
"""Values that say what is usual, and the share of all from which there are no outliers."""


def outliers(y: Array, period: float) -> Booleans:
    """Return which of finite values, (N,), are far from most of the five around them.

    Far is beyond the way from those before to those after, and beyond 10 times the median second
    difference near, 1.5 times the median first one, which an end stop turns, and 1.5 times the
    median change of the whole. Differences are taken within half a period.
    """

    def turned(change: Array) -> Array:
        return change - (period * np.round(change / period) if period < math.inf else 0.0)

    def around(part: Array, width: int) -> Array:
        return sliding_window_view(np.pad(part, width // 2, mode="edge"), width)

    first = turned(np.diff(y, prepend=y[0]))
    usual: Array = np.full(
        len(y), np.median(1.5 * np.abs(first[first != 0.0])) if first.any() else 0
    )
    for change, factor in ((turned(np.diff(first, append=first[-1])), 10.0), (first, 1.5)):
        usual = usual + factor * np.median(around(np.abs(change), NEAR), axis=1)
    near = around(y, 5)
    across = np.abs(turned(near[:, 3:, None] - near[:, None, :2])).min(axis=(1, 2))
    apart = np.median(np.abs(turned(near - y[:, None])), axis=1)
    return np.asarray(apart > np.maximum(usual, across))
