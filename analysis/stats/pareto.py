"""Pareto front: what no other choice beats in every respect."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def on_front(costs: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return which of n choices are on the Pareto front of their costs (n, k), lower is better.

    A choice is dominated by another that costs at most as much in every respect and less in one.
    Equal choices do not dominate each other. One with an unknown cost, NaN, is not on the front.
    """
    one, other = costs[:, None, :], costs[None, :, :]
    dominated = np.any(np.all(other <= one, axis=2) & np.any(other < one, axis=2), axis=1)
    found: npt.NDArray[np.bool_] = ~dominated & ~np.isnan(costs).any(axis=1)
    return found
