"""Shared parts of all figures: their interface, style, axes, panels and legends."""

from __future__ import annotations

import math
import textwrap
import unicodedata
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import matplotlib
import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullFormatter

from analysis.data.selection import Selection
from analysis.stats.curves import PlotOptions
from analysis.style import LineStyle
from orchestrate.store import Reader

N = TypeVar("N")

NARROW = 0.62
"""Width of a figure with one column of panels, relative to the page."""

TEXT_WIDTH = 6.75
"""Width of a figure over the page [inches]."""

COLUMN_WIDTH = 4.2
"""Width of a figure of one panel [inches]."""

GUIDE: dict[str, Any] = {"color": "black", "lw": 0.8, "ls": (0, (5, 2))}
"""Look of a straight line that marks a value, such as a limit."""

_RC: dict[Any, Any] = {
    "font.size": 8,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.2,
    "figure.dpi": 200,
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "dopt",
    "path.simplify": False,
}

_LETTERS = {"φ": r"\varphi"}

MARKERS = "osD^vP*X<>ph"
"""Markers in the order of a legend: more than colours and lines can tell apart."""

TAU_TICKS = {0: "0", 1: "π/2", 2: "π", 3: "3π/2", 4: "2π"}

TICKS: dict[float, tuple[float, ...]] = {
    0.8: (1, 1.5, 2, 3, 4, 5, 7),
    1.0: (1, 2, 3, 5),
    1.5: (1, 2, 5),
    2.5: (1, 3),
    math.inf: (1,),
}
"""Labelled multiples of a power of ten, by the decades of an axis below which they hold."""

SHORT = 0.5
"""Decades below which an axis has evenly spaced ticks: multiples of a power of ten would be few."""

_FEWEST = 20
"""Letters of a line of a label at least, where even one column is too wide."""


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

    title: str
    statistic: str
    band: str
    part: Callable[[Selection, PlotOptions], Selection]
    measure: Callable[[Reader, Selection, PlotOptions], N]
    tabulate: Callable[[N], pd.DataFrame]
    draw: Callable[[N], Figure]
    caption: Callable[[N], str]

    def words(self, options: PlotOptions) -> dict[str, str]:
        """Return the title, the statistic and the band of some options, for the provenance."""
        names = {"centre": options.statistic.label, "interval": options.statistic.band}
        return {
            "title": self.title,
            "statistic": self.statistic.format(**names),
            "band": self.band.format(**names),
        }

    def make(self, reader: Reader, selection: Selection, options: PlotOptions) -> Drawing:
        """Read, measure, then draw."""
        numbers = self.measure(reader, selection, options)
        return Drawing(self.draw(numbers), self.tabulate(numbers), self.caption(numbers))


def styled() -> AbstractContextManager[None]:
    """Return the context in which figures are made and written, whatever a matplotlibrc says."""
    defaults: dict[Any, Any] = {**matplotlib.rcParamsDefault}
    del defaults["backend"]  # none is needed, and to ask for it looks for one
    return matplotlib.rc_context({**defaults, **_RC})


def blank(columns: int, height: float, width: float | None = None) -> Figure:
    """Return an empty figure: as wide as the page, narrower for one column, or ``width`` inches."""
    if width is None:
        width = TEXT_WIDTH * (1.0 if columns > 1 else NARROW)
    return Figure(figsize=(width, height), layout="constrained")


def sheet(
    rows: int,
    columns: int,
    panel: float,
    around: float = 0.0,
    width: float | None = None,
    **sharing: Any,
) -> tuple[Figure, npt.NDArray[Any]]:
    """Return a figure and its axes (rows, columns); ``panel`` is the height of a row [inches].

    ``around`` is what the legend and the title add; ``sharing`` are options of ``subplots``.
    """
    figure = blank(columns, panel * rows + around, width)
    return figure, figure.subplots(rows, columns, squeeze=False, **sharing)


def look(style: LineStyle) -> dict[str, Any]:
    """Return a style as options of a line."""
    return {"color": style.colour, "ls": style.line, "lw": style.width}


def mathematical(label: str) -> str:
    """Return a label whose dotted letters are set as mathematics, where the dot sits well."""
    pieces: list[str] = []
    for letter in unicodedata.normalize("NFD", label):
        if letter == "\N{COMBINING DOT ABOVE}":
            pieces[-1] = f"$\\dot{{{_LETTERS.get(pieces[-1], pieces[-1])}}}$"
        else:
            pieces.append(letter)
    return "".join(pieces)


def log_scale(axes: Axes, low: float, high: float, axis: str = "y") -> None:
    """Make an axis, by default the vertical one, logarithmic over [low, high]."""
    axes.set(**{f"{axis}scale": "log", f"{axis}lim": (low, high)})
    log_ticks(getattr(axes, f"{axis}axis"), low, high)


def half_widths(centre: npt.ArrayLike, low: npt.ArrayLike, high: npt.ArrayLike) -> Any:
    """Return the lower and upper half of an interval, (2, ...); 0 without an interval."""
    found = np.stack([np.subtract(centre, low), np.subtract(high, centre)])
    return np.maximum(0.0, np.nan_to_num(found))


def shade(axes: Axes, x: npt.ArrayLike, band: Any, colour: str) -> None:
    """Fill the interval of a band along x."""
    axes.fill_between(x, band.low, band.high, color=colour, alpha=0.18, lw=0)


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Set ticks of a logarithmic axis over [low, high], with at least a few labels."""
    decades = math.log10(high / low)
    steps = next(steps for limit, steps in TICKS.items() if decades < limit)
    if decades < SHORT:
        axis.set_major_locator(MaxNLocator(nbins=5, min_n_ticks=3, steps=[1, 2, 2.5, 5, 10]))
    else:
        axis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.set_minor_locator(LogLocator(subs=tuple(range(2, 10)), numticks=40))
    axis.set_minor_formatter(NullFormatter())
    if decades < 4:
        axis.set_major_formatter(FuncFormatter(lambda value, _: log_text(value)))


def log_text(value: float) -> str:
    """Return a tick's value, below 0.01 as a power of ten such as 3 × 10⁻⁴."""
    if value >= 0.009:
        return f"{value:g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    factor = round(value / 10.0**exponent, 6)
    return f"$10^{{{exponent}}}$" if factor == 1 else f"${factor:g}\\times10^{{{exponent}}}$"


def angle_ticks(axis: Axis) -> None:
    """Label an angle in multiples of π/2."""
    axis.set_major_locator(MultipleLocator(math.pi / 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: angle_text(value)))


def angle_text(angle: float) -> str:
    """Return a multiple of π/2 as text, such as ``-π/2``."""
    count = round(angle / (math.pi / 2))
    text = TAU_TICKS.get(abs(count)) or f"{abs(count) / 2:g}π"
    return f"\N{MINUS SIGN}{text}" if count < 0 else text


def rows_and_columns(panels: int, widest: int) -> tuple[int, int]:
    """Return a grid for some panels, at most ``widest`` in a row, as square as that allows."""
    columns = min(panels, widest)
    if panels == 4:
        columns = min(widest, 2) if widest < 4 else 4
    return math.ceil(panels / columns), columns


def mark_break(upper: Axes, lower: Axes) -> None:
    """Draw the two slanted strokes between the parts, and leave one time axis."""
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(axis="x", which="both", bottom=False, labelbottom=False)
    stroke: dict[str, Any] = {"marker": [(-1, -0.6), (1, 0.6)], "ms": 7, "ls": "none"}
    stroke |= {"color": "black", "mew": 0.7, "clip_on": False}
    upper.plot([0], [0], transform=upper.transAxes, **stroke)
    lower.plot([0], [1], transform=lower.transAxes, **stroke)


def legend_below(figure: Figure, ncols: int, **options: Any) -> Legend:
    """Add a legend of at most ``ncols`` columns; a figure grows by the rows that this adds.

    ``options`` go to ``Figure.legend``. Labels too long for one column are wrapped.
    """
    legend = _place_legend(figure, ncols, options)
    planned = legend.get_window_extent().height
    while ncols > 1 and _excess(figure, legend) > 1:
        ncols -= 1
        legend.remove()
        legend = _place_legend(figure, ncols, options)
    letters = max((len(text.get_text()) for text in legend.get_texts()), default=0)
    while letters > _FEWEST and _excess(figure, legend) > 1:
        letters -= 1
        for text in legend.get_texts():
            text.set_text(textwrap.fill(" ".join(text.get_text().split()), letters))
    extra = legend.get_window_extent().height - planned
    if extra > 0:
        figure.set_figheight(float(figure.get_figheight() + extra / figure.dpi))
    return legend


def _place_legend(figure: Figure, ncols: int, options: dict[str, Any]) -> Legend:
    return figure.legend(loc="outside lower center", ncols=ncols, **options)


def _excess(figure: Figure, legend: Legend) -> float:
    """Return the width of a legend relative to its figure."""
    return float(legend.get_window_extent().width / figure.bbox.width)
