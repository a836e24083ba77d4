"""Interface of a figure: its requirements, measured numbers, table, drawing and caption."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import pandas as pd
from matplotlib.figure import Figure

from analysis.data.trial_selection import Selection
from analysis.plot_options import PlotOptions
from orchestrate.store import Reader

N = TypeVar("N")


@dataclass(frozen=True)
class Drawing:
    """A figure before it is written: its ink, the table of what is drawn, and its caption."""

    figure: Figure
    table: pd.DataFrame
    caption: str


@dataclass(frozen=True)
class Plot(Generic[N]):
    """A kind of figure over numbers of type N.

    ``part`` cuts the selection down to what this figure shows; without entries it is not drawn.
    ``statistic`` and ``band`` say in words what is drawn; ``{centre}`` and ``{interval}`` in them
    stand for what the options ask for.
    """

    name: str
    title: str
    statistic: str
    band: str
    part: Callable[[Selection], Selection]
    measure: Callable[[Reader, Selection, PlotOptions], N]
    tabulate: Callable[[N], pd.DataFrame]
    draw: Callable[[N], Figure]
    caption: Callable[[N], str]

    def words(self, options: PlotOptions) -> dict[str, str]:
        """Return the title, the statistic and the band of some options, for the provenance."""
        names = {"centre": options.statistic.label, "interval": options.interval}
        return {
            "title": self.title,
            "statistic": self.statistic.format(**names),
            "band": self.band.format(**names),
        }

    def make(self, reader: Reader, selection: Selection, options: PlotOptions) -> Drawing:
        """Read, measure, then draw."""
        numbers = self.measure(reader, selection, options)
        return Drawing(self.draw(numbers), self.tabulate(numbers), self.caption(numbers))
