"""How much of the evaluation box a trajectory visits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

CELLS = 20
"""Cells along each side of the box."""

Box = tuple[tuple[float, float], tuple[float, float]]


def coverage(points: Array, box: Box, cells: int = CELLS) -> float:
    """Return the share of the cells² equal cells of a box that hold at least one of (n, 2) points.

    Angles are to be wrapped beforehand; points outside the box and NaN count nowhere.
    """
    counts, _, _ = np.histogram2d(
        points[:, 0], points[:, 1], bins=cells, range=[list(side) for side in box]
    )
    return float(np.mean(counts > 0))
