"""Figure 8: final loss against single settings, a row for each environment."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.trial_selection import policy_rank
from analysis.figures.axes import log_limits, log_scale, value_ticks
from analysis.figures.legend import legend_below
from analysis.figures.plot import Plot
from analysis.figures.sensitivity.data import (
    Line,
    measure_lines,
    sensitivity_part,
    tabulate_lines,
)
from analysis.figures.style import GUIDE, TEXT_WIDTH
from analysis.formatting import count_text
from analysis.line_styles import environment_title, policy_style, text_by_environment
from analysis.stats.intervals import STUDENT_RANGE
from dopt.policies.titles import policy_title
from dopt.spec.label import value_label

ROW_HEIGHT = 1.45
AROUND = 0.7
NAMES = {
    "policy.regularization": "λ of the information matrix",
    "learner.learning_rate": "learning rate",
    "learner.window": "window [samples]",
}
Lines = tuple[Line, ...]


def sensitivity_plot(name: str) -> Plot[Lines]:
    """Return final loss against λ, the learning rate and the window."""
    return Plot(
        name=name,
        title="Final loss against single settings",
        statistic="geometric mean over trials of the loss after the last step",
        band=f"95 % interval of the mean logarithm (BCa bootstrap, {STUDENT_RANGE} trials)",
        part=sensitivity_part,
        measure=lambda reader, selection, options: measure_lines(reader, selection, options.rule),
        tabulate=tabulate_lines,
        draw=draw,
        caption=caption,
    )


def draw(lines: Lines) -> Figure:
    """Draw a row for each environment, a column for each setting, a line for each policy."""
    environments, settings, policies = (
        list(dict.fromkeys(getattr(line, name) for line in lines))
        for name in ("env", "setting", "policy")
    )
    rows, columns = len(environments), len(settings)
    size = (TEXT_WIDTH if columns > 1 else TEXT_WIDTH * 0.62, ROW_HEIGHT * rows + AROUND)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex="col", sharey="row", squeeze=False)
    for row, env in zip(grid, environments, strict=True):
        own = [line for line in lines if line.env == env]
        for axes, setting in zip(row, settings, strict=True):
            _panel(axes, [line for line in own if line.setting == setting])
        ends = [(one.value, one.low, one.high) for line in own for one in line.losses]
        log_scale(row[0], *log_limits(np.array(ends).ravel(), margin=1.2))
        row[0].set_ylabel(f"{environment_title(env)}\nfinal RMS error\n[{own[0].unit}]")
    for axes, setting in zip(grid[-1], settings, strict=True):
        axes.set_xlabel(NAMES[setting])
        values = {value for line in lines if line.setting == setting for value in line.values}
        value_ticks(axes.xaxis, values)
    handles = [
        Line2D([], [], marker="o", ms=3, label=style.label, color=style.colour, ls=style.line)
        for style in map(policy_style, sorted(policies, key=policy_rank))
    ]
    handles.append(Line2D([], [], **GUIDE, label="value elsewhere"))
    legend_below(figure, 4, handles=handles)
    return figure


def _panel(axes: Axes, lines: Sequence[Line]) -> None:
    axes.set_xscale("log")
    for line in lines:
        style = policy_style(line.policy)
        if not line.values:
            [level] = line.losses
            axes.axhline(level.value, color=style.colour, ls=style.line, lw=style.width)
            axes.axhspan(level.low, level.high, color=style.colour, alpha=0.18, lw=0)
            continue
        y, low, high = np.array([(one.value, one.low, one.high) for one in line.losses]).T
        axes.errorbar(
            line.values, y, np.nan_to_num([y - low, high - y]), color=style.colour, ls=style.line,
            lw=style.width, marker="o", ms=3, elinewidth=0.7, capsize=1.5,
        )  # fmt: skip
    for usual in {line.usual for line in lines if not math.isnan(line.usual)}:
        axes.axvline(usual, **GUIDE)


def caption(lines: Lines) -> str:
    """Return the caption, with what is drawn, n, and the values without a point."""
    counts = text_by_environment(lines, _counts)
    levels = sorted({policy_title(line.policy) for line in lines if not line.values})
    level = f"Level: {', '.join(levels)}, which has no such setting. " if levels else ""
    return (
        "Root mean square error of the model over the evaluation grid after the last step, against "
        "one setting at a time; all others are as in the configuration whose value is dashed. "
        f"Geometric mean over trials with its 95 % interval (BCa bootstrap, {STUDENT_RANGE} "
        f"trials). {level}A value of which no trial has a positive final loss has no point. "
        f"Trials: {counts}."
    )


def _counts(lines: Sequence[Line]) -> str:
    found = {}
    for line in lines:
        values = line.values or (line.usual,)
        for value, scores in zip(values, line.scores, strict=True):
            words = [] if math.isnan(value) else [value_label(line.setting, value)]
            found[", ".join([policy_title(line.policy), *words])] = scores.describe()
    return count_text(found)
