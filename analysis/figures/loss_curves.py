"""Figure 1: loss against time, one panel per environment, all policies."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis.counts import count_text
from analysis.divergence import DivergenceRule
from analysis.figures.axes import log_ticks, rows_and_columns
from analysis.figures.axis_break import Limits, axis_parts, mark_break
from analysis.figures.plot import Plot, Request
from analysis.figures.style import GREY, TEXT_WIDTH, environment_title, policy_style
from analysis.loss_curves import Axis, LossCurve, measure_curves, tabulate_curves
from analysis.selection import policy_rank
from analysis.statistics import BAND

PANEL_HEIGHT = 2.3

NORM = {
    "loss": r"$\Vert f_\theta - f\,\Vert_2$ on the grid",
    "reachable_loss": r"$\Vert f_\theta - f\,\Vert_2$, reachable set",
}

Numbers = tuple[str, Request, tuple[LossCurve, ...]]


def loss_plot(name: str, column: str) -> Plot[Numbers]:
    """Return the figure of one column of losses."""
    return Plot(
        name=name,
        title=f"Loss curves ({column})",
        statistic=f"mean over trials of {column} at every step",
        band=BAND,
        part=lambda selection: selection,
        measure=lambda reader, selection, request: (
            column,
            request,
            measure_curves(reader, selection, column, request.rule, request.axis),
        ),
        tabulate=lambda numbers: tabulate_curves(numbers[2]),
        draw=draw,
        caption=caption,
    )


def draw(numbers: Numbers) -> Figure:
    """Draw one panel for each environment with a legend below all."""
    column, request, curves = numbers
    envs = list(dict.fromkeys(curve.env for curve in curves))
    rows, columns = rows_and_columns(len(envs), 2)
    size = (TEXT_WIDTH if columns > 1 else TEXT_WIDTH * 0.62, PANEL_HEIGHT * rows + 0.75)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    unit = "steps" if request.axis is Axis.STEPS else "s"
    for index, env in enumerate(envs):
        panel = _panel(figure, grid[index], [curve for curve in curves if curve.env == env])
        if index + columns >= len(envs):
            panel[-1].set_xlabel(f"time t [{unit}]")
        if index % columns == 0:
            panel[0].set_ylabel(NORM.get(column, column))
    handles = legend_handles({curve.policy for curve in curves})
    per_row = 4 if columns > 1 else 2
    figure.legend(handles=handles, loc="outside lower center", ncols=per_row)
    return figure


def _panel(figure: Figure, place: SubplotSpec, curves: Sequence[LossCurve]) -> list[Axes]:
    """Draw one environment, on an axis of two parts where a curve is far below the others."""
    parts = axis_parts([curve.band for curve in curves])
    if parts.lower is None:
        axes = [figure.add_subplot(place)]
        _lines(axes[0], curves, parts.upper)
    else:
        two = place.subgridspec(2, 1, height_ratios=(2.6, 1), hspace=0.03)
        axes = [figure.add_subplot(two[0]), figure.add_subplot(two[1])]
        _lines(axes[0], curves, parts.upper)
        _lines(axes[1], curves, parts.lower)
        mark_break(*axes)
    counts = {policy_style(c.policy).label: c.sample.describe() for c in curves}
    axes[0].set_title(_title(environment_title(curves[0].env), f"({count_text(counts)})"))
    return axes


def _lines(axes: Axes, curves: Sequence[LossCurve], limits: Limits) -> None:
    axes.set_yscale("log")
    for curve in reversed(curves):
        style, band = policy_style(curve.policy), curve.band
        axes.fill_between(curve.x, band.low, band.high, color=style.colour, alpha=0.18, lw=0)
        axes.plot(curve.x, band.mean, color=style.colour, ls=style.line, lw=style.width)
    axes.set_ylim(*limits)
    log_ticks(axes.yaxis, *limits)
    axes.set_xlim(0, max(_end(curve) for curve in curves))


def _title(env: str, counts: str) -> str:
    """Return the title of a panel in one line, or in two where one would not fit."""
    if len(env) + len(counts) < 50:
        return f"{env} {counts}"
    return f"{env}\n" + textwrap.fill(counts, 56)


def _end(curve: LossCurve) -> float:
    """Return x one step after the last loss: the time at which the trial ends."""
    steps = len(curve.x)
    return float(curve.x[-1]) * steps / (steps - 1) if steps > 1 else 1.0


def legend_handles(policies: set[str]) -> list[Artist]:
    """Return a line for each policy, in the order of all figures, and the band's name."""
    handles: list[Artist] = []
    for policy in sorted(policies, key=policy_rank):
        style = policy_style(policy)
        handles.append(
            Line2D([], [], color=style.colour, ls=style.line, lw=style.width, label=style.label)
        )
    return [*handles, Patch(color=GREY, alpha=0.35, lw=0, label=BAND)]


def caption(numbers: Numbers) -> str:
    """Return the caption, with the statistic, the band, n and the rule for diverged trials."""
    column, request, curves = numbers
    where = "evaluation grid" if column == "loss" else "reachable set"
    counts = [
        f"{environment_title(env)} "
        + count_text({c.policy: c.sample.describe() for c in curves if c.env == env})
        for env in dict.fromkeys(c.env for c in curves)
    ]
    rules = {
        DivergenceRule.EXCLUDE: "A diverged trial leaves its whole curve.",
        DivergenceRule.WORST: "A diverged trial counts with the worst loss of each step.",
        DivergenceRule.MEDIAN: "A diverged trial counts with the median loss of each step.",
    }
    return (
        f"L² norm of the model's error over the {where} against time t, one panel per environment. "
        f"Lines: mean over trials; bands: {BAND}; no smoothing. "
        f"An axis with two slanted strokes is broken where no other curve runs. "
        f"{rules[request.rule]} Policies of one environment share initial weights and noise for "
        f"the same seed. Trials: {'. '.join(counts)}."
    )
