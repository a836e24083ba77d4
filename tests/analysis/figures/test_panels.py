"""Legends and broken axes."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures.panels import COLUMN_WIDTH, legend_below, styled
from analysis.stats.curves import axis_parts, band_limits
from analysis.stats.intervals import Band

SHORT = ("D-optimal", "random", "95 % interval")


LONG = tuple(f"curiosity, candidates={n}, grid_half_widths=[3, 3]" for n in range(5))


ENDLESS = tuple("a label of many words " * n for n in (6, 9))


@pytest.mark.parametrize(
    ("labels", "columns", "grows"), [(SHORT, 3, False), (LONG, 1, True), (ENDLESS, 1, True)]
)
def test_a_legend_has_as_many_columns_as_fit_into_its_figure(
    labels: tuple[str, ...], columns: int, grows: bool
) -> None:
    with styled():
        figure = Figure(figsize=(COLUMN_WIDTH, 3), layout="constrained")
        axes = figure.subplots()
        planned = axes.get_window_extent().height
        legend = legend_below(figure, 3, handles=[Line2D([], [], label=one) for one in labels])
        FigureCanvasAgg(figure).draw()
        box = legend.get_window_extent()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
        assert legend._ncols == columns
        assert bool(figure.get_figheight() > 3) == grows
        assert axes.get_window_extent().height > 0.7 * planned


def test_the_words_of_a_wrapped_label_stay() -> None:
    with styled():
        figure = Figure(figsize=(COLUMN_WIDTH, 3), layout="constrained")
        figure.subplots()
        handles = [Line2D([], [], label=one) for one in ENDLESS]
        texts = legend_below(figure, 2, handles=handles).get_texts()
    assert [text.get_text().split() for text in texts] == [one.split() for one in ENDLESS]


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
