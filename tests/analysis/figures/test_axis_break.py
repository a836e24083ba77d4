from __future__ import annotations

import numpy as np

from analysis.figures.axis_break import axis_parts, band_limits
from analysis.stats.intervals import Band


def band(*mean: float, half: float = 0.1) -> Band:
    centre = np.array(mean)
    return Band(centre, centre * (1 - half), centre * (1 + half), 5)


def test_neighbours_share_one_axis() -> None:
    parts = axis_parts([band(10, 5, 2), band(10, 3, 1), band(9, 1, 0.5)])
    assert parts.lower is None
    assert parts.upper[0] < 0.45
    assert parts.upper[1] > 11


def test_a_far_lower_curve_gets_a_part_of_its_own() -> None:
    low = band(10, *[1e-3] * 19)
    parts = axis_parts([band(*np.linspace(10, 1, 20)), low, band(*np.linspace(8, 2, 20))])
    assert parts.lower is not None
    assert 0.3 < parts.upper[0] < 1
    assert parts.upper[1] > 10
    assert parts.lower[0] < 0.9e-3
    assert 1e-3 < parts.lower[1] < parts.upper[0]


def test_the_lower_part_shows_the_low_curve_once_it_has_settled() -> None:
    falling = band(*np.geomspace(10, 1e-4, 100))
    parts = axis_parts([band(*np.linspace(10, 1, 100)), falling])
    assert parts.lower is not None
    assert parts.lower[1] <= parts.upper[0]
    assert parts.lower[0] < 1e-4


def test_empty_and_nan_curves_do_not_matter() -> None:
    empty = np.full(3, np.nan)
    nothing = Band(empty, empty, empty, 0)
    assert axis_parts([nothing]).upper == (0.1, 1.0)
    assert axis_parts([nothing, band(3, 2, 1)]) == axis_parts([band(3, 2, 1)])


def test_a_band_that_reaches_zero_does_not_stretch_the_axis() -> None:
    low, high = band_limits([band(4, 3, 2, half=0.999)])
    assert low > 0.5
    assert high < 10
