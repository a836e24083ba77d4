"""Figure 4: cost of a step against the width of the network, and its final loss."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.figures.axes import log_limits, log_scale, value_ticks
from analysis.figures.legend import legend_below
from analysis.figures.loss_curves.plot import loss_label
from analysis.figures.plot import Plot
from analysis.figures.style import COLUMN_WIDTH, GUIDE
from analysis.figures.width.data import (
    Cost,
    WidthCosts,
    WidthLosses,
    measure_costs,
    measure_losses,
    tabulate_costs,
    tabulate_losses,
    width_part,
)
from analysis.formatting import count_text
from analysis.line_styles import BLUE, GREEN, GREY, VERMILLION, environment_title, policy_style

HEIGHT = 3.2
LOSS_HEIGHT = 2.6
COLOURS = {"plan": VERMILLION, "learn": BLUE, "evaluate": GREEN}
MARKERS = {"plan": "o", "learn": "s", "evaluate": "^"}
FORM_WORDS = {"auto": "the cheapest at each width"}
FORM_LINES = {"primal": (0, (5, 2)), "dual": (0, (1.5, 1.5)), "sketch": (0, (5, 1.5, 1, 1.5))}


def cost_plot(name: str) -> Plot[WidthCosts]:
    """Return the cost of a step against width."""
    return Plot(
        name=name,
        title="Planning cost against width",
        statistic="median over steps and trials of the microseconds of each part of a step",
        band="10 % to 90 % quantiles over steps and trials",
        part=width_part,
        measure=lambda reader, selection, _: measure_costs(reader, selection),
        tabulate=tabulate_costs,
        draw=draw_costs,
        caption=caption_costs,
    )


def loss_against_width_plot(name: str) -> Plot[WidthLosses]:
    """Return the final loss against width."""
    return Plot(
        name=name,
        title="Final loss against width",
        statistic="mean over trials of the loss after the last step",
        band="± 2 standard errors of the mean",
        part=width_part,
        measure=lambda reader, selection, options: measure_losses(reader, selection, options.rule),
        tabulate=tabulate_losses,
        draw=draw_losses,
        caption=caption_losses,
    )


def draw_costs(numbers: WidthCosts) -> Figure:
    """Draw every part of a step on logarithmic axes, with the time that a step may take."""
    figure, axes = _axes(HEIGHT, numbers.costs[0].widths)
    axes.axhline(numbers.limit_us, **GUIDE)
    limit = f"real time: dt = {numbers.limit_us / 1e3:g} ms"
    axes.annotate(
        limit, (0, numbers.limit_us), xycoords=("axes fraction", "data"), xytext=(3, -3),
        textcoords="offset points", ha="left", va="top", fontsize=6.5,
    )  # fmt: skip
    for cost in numbers.costs:
        _line(axes, cost, other=cost.form != numbers.costs[0].form)
    drawn = np.concatenate([np.r_[cost.low, cost.high] for cost in numbers.costs])
    log_scale(axes, *log_limits(np.r_[drawn, numbers.limit_us], margin=1.5))
    axes.set_ylabel("time per step [µs]")
    axes.set_title(f"{policy_style(numbers.policy).label}, {environment_title(numbers.env)}")
    legend_below(figure, 2)
    return figure


def _axes(height: float, widths: np.ndarray[tuple[int], np.dtype[np.int64]]) -> tuple[Figure, Axes]:
    """Return a figure of one panel whose horizontal ticks are the widths."""
    figure = Figure(figsize=(COLUMN_WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlabel("width w [units in each hidden layer]")
    value_ticks(axes.xaxis, widths.tolist())
    return figure, axes


def _line(axes: Axes, cost: Cost, *, other: bool) -> None:
    colour = GREY if other else COLOURS[cost.part]
    style = FORM_LINES.get(cost.form, "-") if other else "-"
    name = f"{cost.part}, {cost.form} form" if other else cost.part
    if not other:
        axes.fill_between(cost.widths, cost.low, cost.high, color=colour, alpha=0.15, lw=0)
    label = f"{name}: $\\propto w^{{{cost.exponent:.1f}}}$"
    marker = MARKERS[cost.part]
    axes.plot(cost.widths, cost.median, color=colour, ls=style, marker=marker, ms=3, label=label)


def caption_costs(numbers: WidthCosts) -> str:
    """Return the caption, with what the parts are and how the slopes are fitted."""
    first = numbers.costs[0]
    counts = {str(w): str(n) for w, n in zip(first.widths, first.n, strict=True)}
    others = [cost.form for cost in numbers.costs[1:] if cost.form != first.form]
    beside = f" In grey: planning with the {' and the '.join(others)} form." if others else ""
    return (
        f"Time per step against the width of both hidden layers, "
        f"{policy_style(numbers.policy).label} in the {environment_title(numbers.env)}, one "
        f"trial on a core: planning with the update of the information matrix (form: "
        f"{FORM_WORDS.get(first.form, first.form)}), one step of learning, one evaluation of the "
        f"loss. Points: median over steps and trials; bands: 10 % to 90 % quantiles. Exponents: "
        f"least squares on logarithms over the upper half of the widths. Dashed: the time between "
        f"two steps.{beside} "
        f"Trials by width: {count_text(counts)}."
    )


def draw_losses(numbers: WidthLosses) -> Figure:
    """Draw the mean final loss with two standard errors, and n in the title."""
    figure, axes = _axes(LOSS_HEIGHT, numbers.widths)
    style, half = policy_style(numbers.policy), 2 * numbers.error
    axes.errorbar(
        numbers.widths, numbers.mean, np.nan_to_num(half), color=style.colour, marker="o", ms=3,
        capsize=2,
    )  # fmt: skip
    edges = np.r_[numbers.mean - half, numbers.mean + half, numbers.mean]
    log_scale(axes, *log_limits(edges, margin=1.35))
    axes.set_ylabel(f"final {loss_label('loss', numbers.unit)}")
    axes.set_title(f"{style.label}, {environment_title(numbers.env)} ({_counts(numbers)})")
    return figure


def _counts(numbers: WidthLosses) -> str:
    return count_text(dict(zip(map(str, numbers.widths), numbers.counts, strict=True)))


def caption_losses(numbers: WidthLosses) -> str:
    """Return the caption, with the statistic and n by width."""
    return (
        f"Root mean square error of the model over the evaluation grid after the last step, "
        f"against the width of both hidden layers, {policy_style(numbers.policy).label} in the "
        f"{environment_title(numbers.env)}: mean over trials ± 2 standard errors. "
        f"Trials by width: {_counts(numbers)}."
    )
