"""Helpers for axes: logarithmic ones with readable ticks, multiples of π, panels in rows."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    MultipleLocator,
    NullFormatter,
    NullLocator,
)

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


def log_scale(axes: Axes, low: float, high: float) -> None:
    """Make the vertical axis a logarithmic one over [low, high], with readable ticks."""
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    log_ticks(axes.yaxis, low, high)


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


def value_ticks(axis: Axis, values: Iterable[float]) -> None:
    """Set ticks of a logarithmic axis at values, and nowhere else."""
    axis.set_major_locator(FixedLocator(sorted(values)))
    axis.set_minor_locator(NullLocator())
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


def log_limits(values: npt.NDArray[np.float64], margin: float = 1.15) -> tuple[float, float]:
    """Return limits around the positive, finite ones of some values; (0.1, 1) for none."""
    usable = values[np.isfinite(values) & (values > 0)]
    if not len(usable):
        return 0.1, 1.0
    return float(usable.min()) / margin, float(usable.max()) * margin


def rows_and_columns(panels: int, widest: int) -> tuple[int, int]:
    """Return a grid for some panels, at most ``widest`` in a row, as square as that allows."""
    columns = min(panels, widest)
    if panels == 4:
        columns = min(widest, 2) if widest < 4 else 4
    return math.ceil(panels / columns), columns
