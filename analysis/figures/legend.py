"""Legends below the panels of a figure, in as many columns as fit into its width."""

from __future__ import annotations

import textwrap
from typing import Any

from matplotlib.figure import Figure
from matplotlib.legend import Legend

_FEWEST = 20
"""Letters of a line of a label at least, where even one column is too wide."""


def legend_below(figure: Figure, ncols: int, **options: Any) -> Legend:
    """Add a legend of at most ``ncols`` columns; a figure grows by the rows that this adds.

    ``options`` are those of ``Figure.legend``. Labels too long for one column are wrapped.
    """
    legend = _legend(figure, ncols, options)
    planned = legend.get_window_extent().height
    while ncols > 1 and _excess(figure, legend) > 1:
        ncols -= 1
        legend.remove()
        legend = _legend(figure, ncols, options)
    letters = max((len(text.get_text()) for text in legend.get_texts()), default=0)
    while letters > _FEWEST and _excess(figure, legend) > 1:
        letters -= 1
        for text in legend.get_texts():
            text.set_text(textwrap.fill(" ".join(text.get_text().split()), letters))
    extra = legend.get_window_extent().height - planned
    if extra > 0:
        figure.set_figheight(float(figure.get_figheight() + extra / figure.dpi))
    return legend


def _legend(figure: Figure, ncols: int, options: dict[str, Any]) -> Legend:
    return figure.legend(loc="outside lower center", ncols=ncols, **options)


def _excess(figure: Figure, legend: Legend) -> float:
    """Return the width of a legend by that of its figure."""
    return float(legend.get_window_extent().width / figure.bbox.width)
