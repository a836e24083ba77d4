"""Forest plot of one system in a report: ratios of the final loss to the reference's."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.matching import APART
from analysis.figures.panels import TEXT_WIDTH, half_widths, log_ticks, sheet
from analysis.style import BLUE, GREY, VERMILLION
from analysis.tables.rendering import records
from analysis.tables.variants import verdict

_LOOK = {"better": (BLUE, "o"), "worse": (VERMILLION, "s"), "open": (GREY, "D")}
_INCHES_PER_ROW = 0.16
_INCHES_AROUND = 0.62


def draw_forest(part: pd.DataFrame) -> Figure:
    """Return the figure of one system's rows of :func:`analysis.tables.variants.adjust`."""
    known = part[part["loss_ratio"].notna() & (part["policy"] != APART)]
    rows = known.sort_values("loss_ratio", ascending=False, kind="stable")
    height = _INCHES_AROUND + _INCHES_PER_ROW * len(rows)
    figure, [[axes]] = sheet(1, 1, height, width=TEXT_WIDTH)
    _fill(axes, rows)
    axes.set_xlabel(f"final loss / final loss of {part['variant'].iloc[0]}")
    return figure


def _fill(axes: Axes, part: pd.DataFrame) -> None:
    for place, row in enumerate(records(part)):
        colour, marker = _LOOK[verdict(row)]
        ends = [[row[f"loss_{name}"]] for name in ("ratio", "low", "high")]
        axes.errorbar(
            ends[0],
            place,
            xerr=half_widths(*ends),
            fmt=marker,
            color=colour,
            ms=3.5,
            elinewidth=1.0,
        )
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    log_ticks(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(range(len(part)), list(part["variant"]), fontsize=6.5)
    axes.set_ylim(-0.7, len(part) - 0.3)
    axes.grid(axis="y", visible=False)
