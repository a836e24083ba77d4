"""Legends below a figure: they fit into its width, and stay as planned where they fitted."""

from __future__ import annotations

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures.legend import legend_below
from analysis.figures.style import COLUMN_WIDTH, styled

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
