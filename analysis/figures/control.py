"""Figure 5: control with the learned model against explored steps."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.selection import policy_rank
from analysis.figures.panels import (
    GUIDE,
    MARKERS,
    TEXT_WIDTH,
    Plot,
    half_widths,
    legend_below,
    log_scale,
    look,
    sheet,
)
from analysis.stats.curves import log_limits
from analysis.stats.scores import ControlCurve, control_part, measure_control, tabulate_control
from analysis.style import count_text, environment_title, policy_style, share, text_by_environment

ROW_HEIGHT = 1.9
LEGEND_HEIGHT = 0.5
SHARE = 0.008
"""Distance of neighbouring policies' bars, as a part of the axis."""

TRUTH = {**GUIDE, "lw": 0.6}
"""Look of what the planner achieves with the true model."""

Curves = tuple[ControlCurve, ...]


def draw_control(curves: Curves) -> Figure:
    """Draw the share of successes above the relative cost, one column for each environment."""
    environments = list(dict.fromkeys(curve.env for curve in curves))
    figure, grid = sheet(2, len(environments), ROW_HEIGHT, LEGEND_HEIGHT, TEXT_WIDTH, sharex="col")
    policies = sorted({curve.policy for curve in curves}, key=policy_rank)
    markers = dict(zip(policies, itertools.cycle(MARKERS), strict=False))
    for column, env in enumerate(environments):
        own = [curve for curve in curves if curve.env == env]
        _panel(grid[0, column], grid[1, column], own, markers)
    grid[0, 0].set_ylabel("success rate")
    grid[1, 0].set_ylabel("cost / cost with\nthe true model")
    handles = [
        Line2D([], [], ms=3.5, label=policy_style(policy).label, **_look(policy, markers))
        for policy in policies
    ]
    handles.append(Line2D([], [], **TRUTH, label="true model"))
    legend_below(figure, min(4, len(handles)), handles=handles)
    return figure


def _panel(
    rates: Axes, costs: Axes, curves: Sequence[ControlCurve], markers: Mapping[str, str]
) -> None:
    last = max(int(curve.t[-1]) for curve in curves)
    for place, curve in reversed(list(enumerate(curves))):
        x = curve.t + SHARE * last * (place - (len(curves) - 1) / 2)
        _line(rates, x, curve, "success", _look(curve.policy, markers))
        _line(costs, x, curve, "cost", _look(curve.policy, markers))
    rates.set_title(f"{environment_title(curves[0].env)}\n({_counts(curves)})", fontsize=7)
    rates.set_ylim(-0.04, 1.04)
    rates.axhline(curves[0].truth.success, **TRUTH)
    drawn = [np.r_[c.cost, c.cost_low, c.cost_high, 1.0] for c in curves]
    log_scale(costs, *log_limits(np.concatenate(drawn)))
    costs.axhline(1.0, **TRUTH)
    costs.set_xticks(sorted({int(t) for curve in curves for t in curve.t}))
    costs.set_xlabel("explored steps")


def _look(policy: str, markers: Mapping[str, str]) -> dict[str, Any]:
    return look(policy_style(policy)) | {"marker": markers[policy]}


def _line(axes: Axes, x: np.ndarray, curve: ControlCurve, name: str, own: dict[str, Any]) -> None:
    ends = [getattr(curve, f"{name}{end}") for end in ("", "_low", "_high")]
    axes.errorbar(x, ends[0], half_widths(*ends), ms=3, elinewidth=0.7, capsize=1.5, **own)


def _counts(curves: Sequence[ControlCurve]) -> str:
    return count_text({policy_style(curve.policy).label: curve.counts for curve in curves})


def caption_control(curves: Curves) -> str:
    """Return the caption, with what an episode is and n by environment."""
    counts = text_by_environment(curves, _counts)
    return (
        "Control with the model learned after some explored steps, by model-predictive control "
        "(cross-entropy method) on the true system with its noise: swing-up of the pendulum and "
        "the cartpole, a set-point of the arm and the quadrotor. Above: share of successful "
        "episodes with 95 % Wilson intervals; dashed: of the same planner with the true model, on "
        f"the same seeds ({_truths(curves)}). Below: cost of the episode divided by the true "
        "model's under the same planner, noise and draws (dashed: equal), geometric mean over "
        "trials with 95 % t-intervals of the mean logarithm. At 0 steps the model is untrained. "
        f"Points of a number of steps are drawn side by side. {_lost(curves)}{counts}."
    )


def _truths(curves: Curves) -> str:
    """Return the true model's share of successes, by environment."""
    truths = {environment_title(curve.env): curve.truth for curve in curves}
    return ", ".join(f"{env} {share(truth.success)}" for env, truth in truths.items())


def _lost(curves: Curves) -> str:
    """Return what a lost episode is, or nothing where none was."""
    if not any(np.any(curve.lost) for curve in curves):
        return ""
    return (
        "Lost: episodes, after any number of steps, without a finite cost of their own or of the "
        "true model's; they are in the success rate and in no mean of costs. "
    )


CONTROL: Plot[Curves] = Plot(
    title="Control with the learned model",
    statistic="share of successful episodes; geometric mean of the cost by the true model's",
    band="95 % Wilson interval of the share; 95 % t-interval of the mean logarithm",
    part=lambda selection, _: control_part(selection),
    measure=lambda reader, selection, _: measure_control(reader, selection),
    tabulate=tabulate_control,
    draw=draw_control,
    caption=caption_control,
)
"""Success and cost of control against explored steps, a column for each task."""
