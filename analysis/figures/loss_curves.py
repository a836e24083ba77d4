"""Figure 1: loss against time, one panel per environment, a line for each policy or value."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis.data.selection import policy_rank, why_impossible
from analysis.figures.panels import (
    Plot,
    blank,
    half_widths,
    legend_below,
    log_scale,
    look,
    mark_break,
    rows_and_columns,
    shade,
)
from analysis.stats.curves import (
    Axis,
    Limits,
    LossCurve,
    PlotOptions,
    Spread,
    axis_parts,
    measure_curves,
    tabulate_curves,
)
from analysis.style import GREY, LineStyle, count_text, environment_title
from dopt.policies import policy_title

PANEL_HEIGHT = 2.3
PLACES = {"loss": "grid", "reachable_loss": "reachable set"}
"""Points at which the error of the model is evaluated, by column of a step."""

BARS = 12
"""Steps at which error bars are drawn."""

_SPREADS = {Spread.BAND: "bands", Spread.ERRORBAR: f"bars at {BARS} steps"}
Numbers = tuple[str, PlotOptions, tuple[LossCurve, ...]]


def loss_plot(column: str) -> Plot[Numbers]:
    """Return the figure of one column of losses."""
    return Plot(
        title=f"Loss curves ({column})",
        statistic=f"{{centre}} over trials of {column} at every step",
        band="{interval}",
        part=lambda selection, _: selection,
        measure=lambda reader, selection, options: (
            column,
            options,
            measure_curves(reader, selection, column, options),
        ),
        tabulate=lambda numbers: tabulate_curves(numbers[2]),
        draw=draw,
        caption=caption,
    )


def draw(numbers: Numbers) -> Figure:
    """Draw one panel for each environment with a legend below all."""
    column, options, curves = numbers
    envs = list(dict.fromkeys(curve.env for curve in curves))
    rows, columns = rows_and_columns(len(envs), 2)
    figure = blank(columns, PANEL_HEIGHT * rows + 0.75)
    grid = figure.add_gridspec(rows, columns)
    unit = "steps" if options.axis is Axis.STEPS else "s"
    for index, env in enumerate(envs):
        shown = [curve for curve in curves if curve.env == env]
        panel = _panel(figure, grid[index], shown, options.spread, list(_absent(curves, env)))
        if index + columns >= len(envs):
            panel[-1].set_xlabel(f"time t [{unit}]")
        panel[0].set_ylabel(loss_label(column, shown[0].unit, shown[0].is_prequential))
    ordered = sorted(curves, key=lambda curve: policy_rank(curve.policy))
    handles = legend_handles({curve.label: curve.style for curve in ordered}, options)
    legend_below(figure, 4 if columns > 1 else 2, handles=handles)
    return figure


def _panel(
    figure: Figure,
    place: SubplotSpec,
    curves: Sequence[LossCurve],
    spread: Spread,
    absent: Sequence[str],
) -> list[Axes]:
    """Draw one environment, on an axis of two parts where a curve is far below the others."""
    parts = axis_parts([curve.band for curve in curves])
    if parts.lower is None:
        axes = [figure.add_subplot(place)]
        _lines(axes[0], curves, parts.upper, spread)
    else:
        two = place.subgridspec(2, 1, height_ratios=(2.6, 1), hspace=0.03)
        axes = [figure.add_subplot(two[0]), figure.add_subplot(two[1])]
        _lines(axes[0], curves, parts.upper, spread)
        _lines(axes[1], curves, parts.lower, spread)
        mark_break(*axes)
    counts = {curve.label: curve.sample.describe() for curve in curves}
    text = "; no ".join([count_text(counts), *map(policy_title, absent)])
    axes[0].set_title(_title(environment_title(curves[0].env), f"({text})"))
    return axes


def _absent(curves: Sequence[LossCurve], env: str) -> dict[str, str]:
    """Return the policies that other environments have and this one cannot, with the reason."""
    there = {curve.policy for curve in curves if curve.env == env}
    others = sorted({curve.policy for curve in curves} - there, key=policy_rank)
    reasons = {policy: why_impossible(env, policy) for policy in others}
    return {policy: reason for policy, reason in reasons.items() if reason}


def _lines(axes: Axes, curves: Sequence[LossCurve], limits: Limits, spread: Spread) -> None:
    for place, curve in reversed(list(enumerate(curves))):
        style, band = curve.style, curve.band
        axes.plot(curve.x, band.centre, **look(style))
        if spread is Spread.BAND:
            shade(axes, curve.x, band, style.colour)
        else:
            _bars(axes, curve, (place + 1) / (len(curves) + 1))
    log_scale(axes, *limits)
    axes.set_xlim(0, max(_end(curve) for curve in curves))


def _bars(axes: Axes, curve: LossCurve, phase: float) -> None:
    """Draw the interval at a few steps; ``phase`` in (0, 1) keeps the policies' bars apart."""
    steps = len(curve.x)
    shown = np.unique(((np.arange(BARS) + phase) * steps / BARS).astype(int))
    band = curve.band
    half = half_widths(band.centre[shown], band.low[shown], band.high[shown])
    axes.errorbar(
        curve.x[shown], band.centre[shown], half, color=curve.style.colour,
        ls="none", elinewidth=0.8, capsize=1.6, capthick=0.8,
    )  # fmt: skip


def loss_label(column: str, unit: str, is_prequential: bool = False) -> str:
    """Return the label of an axis of losses, such as ``RMS error, grid [rad/s²]``."""
    if is_prequential and column == "loss":
        return f"prequential error [{unit}]"
    return f"RMS error, {PLACES.get(column, column)} [{unit}]"


def _breaks(curves: Sequence[LossCurve]) -> str:
    """Return what an axis with a break is, or nothing where no panel has one."""
    for env in dict.fromkeys(curve.env for curve in curves):
        if axis_parts([curve.band for curve in curves if curve.env == env]).lower is not None:
            return (
                "An axis with two slanted strokes is broken where no settled curve runs, its two "
                "parts have different scales. "
            )
    return ""


def _title(env: str, counts: str) -> str:
    """Return the title of a panel in one line, or in more, none of which breaks a count."""
    if len(env) + len(counts) < 50:
        return f"{env} {counts}"
    whole = "; ".join(count.replace(" ", "\N{NO-BREAK SPACE}") for count in counts.split("; "))
    return f"{env}\n" + textwrap.fill(whole, 56)


def _end(curve: LossCurve) -> float:
    """Return x one step after the last loss: the time at which the trial ends."""
    steps = len(curve.x)
    return float(curve.x[-1]) * steps / (steps - 1) if steps > 1 else 1.0


def legend_handles(styles: Mapping[str, LineStyle], options: PlotOptions) -> list[Artist]:
    """Return a line for each label, and the interval's name."""
    handles: list[Artist] = [
        Line2D([], [], label=label, **look(style)) for label, style in styles.items()
    ]
    name = options.interval
    if options.spread is Spread.BAND:
        return [*handles, Patch(color=GREY, alpha=0.35, lw=0, label=name)]
    return [*handles, Line2D([], [], ls="none", marker="|", ms=9, mew=1, color=GREY, label=name)]


def caption(numbers: Numbers) -> str:
    """Return the caption, with the statistic, the band, n and what becomes of diverged trials."""
    column, options, curves = numbers
    counts = [
        f"{environment_title(env)} "
        + count_text({c.label: c.sample.describe() for c in curves if c.env == env})
        for env in dict.fromkeys(c.env for c in curves)
    ]
    envs = dict.fromkeys(curve.env for curve in curves)
    absent = [f" No line: {why}." for env in envs for why in _absent(curves, env).values()]
    return (
        f"{_what(column, curves)} against time t, one panel per environment. "
        f"Lines: {options.statistic.label} over trials; {_SPREADS[options.spread]}: "
        f"{options.interval}; no smoothing. {_breaks(curves)}"
        f"A diverged trial leaves its whole curve. Policies of one environment share initial "
        f"weights and noise for the same seed.{''.join(absent)} Trials: {'. '.join(counts)}."
    )


def _what(column: str, curves: Sequence[LossCurve]) -> str:
    """Return what the curves show; measured explorations have no grid."""
    if column != "loss":
        return "Root mean square error of the model over the reachable set"
    kinds = {curve.is_prequential for curve in curves}
    found = "Root mean square error of the model over the evaluation grid"
    told = "error of each prediction of a measured exploration before it was learned from"
    if kinds == {True}:
        return told.capitalize()
    return f"{found}, or {told}," if True in kinds else found
