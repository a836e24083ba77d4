"""Break of a logarithmic axis, so that one far lower curve does not flatten the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from analysis.figures.axes import log_limits
from analysis.stats.intervals import Band

Array = npt.NDArray[np.float64]
Limits = tuple[float, float]

GAP = 10.0
"""Ratio between the lowest means of two neighbouring curves from which the axis is broken."""

SETTLED = 0.1
"""Share of the steps after which a low curve is shown whole in the lower part."""


@dataclass(frozen=True)
class Parts:
    """Limits of the upper part of an axis, and of the lower one where it is broken."""

    upper: Limits
    lower: Limits | None = None


def axis_parts(bands: Sequence[Band]) -> Parts:
    """Return the limits that show some bands, broken at the widest gap if that is wide enough."""
    shown = [band for band in bands if np.any(band.centre > 0)]
    shown.sort(key=lambda band: _floor(band))
    floors = np.array([_floor(band) for band in shown])
    ratios = floors[1:] / floors[:-1]
    if not len(ratios) or ratios.max() < GAP:
        return Parts(band_limits(shown))
    first = int(np.argmax(ratios)) + 1
    low, high = band_limits(shown[first:])
    top = max(float(np.nanmax(band.centre)) for band in shown)
    bottom, _ = band_limits(shown[:first])
    settled = [band.centre[int(SETTLED * len(band.centre)) :] for band in shown[:first]]
    _, ceiling = log_limits(np.concatenate(settled), margin=1.5)
    return Parts((low, max(high, top)), (bottom, min(ceiling, low)))


def _floor(band: Band) -> float:
    return float(np.min(band.centre[band.centre > 0]))


def band_limits(bands: Sequence[Band]) -> Limits:
    """Return limits that show every mean, and the bands down to a third of the lowest mean."""
    if not bands:
        return log_limits(np.empty(0))
    means = np.concatenate([band.centre for band in bands])
    low, _ = log_limits(means)
    edges = np.concatenate([edge for band in bands for edge in (band.low, band.high)])
    return log_limits(np.concatenate([means, edges[edges > low / 3]]))


def mark_break(upper: Axes, lower: Axes) -> None:
    """Draw the two slanted strokes between the parts, and leave one time axis."""
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(axis="x", which="both", bottom=False, labelbottom=False)
    stroke: dict[str, Any] = {
        "marker": [(-1, -0.6), (1, 0.6)],
        "ms": 7,
        "ls": "none",
        "color": "black",
        "mew": 0.7,
    }
    upper.plot([0], [0], transform=upper.transAxes, clip_on=False, **stroke)
    lower.plot([0], [1], transform=lower.transAxes, clip_on=False, **stroke)
