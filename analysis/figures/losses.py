"""Figure 1, loss against time, and figure 6, final loss against the time of a step.

Both have a panel for each environment. In figure 6 a configuration is a policy, a model and a
learner with all their settings; environments are compared in one env section and one section of
limits each: the ones with most trials.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis.data.matching import APART, USUAL
from analysis.data.samples import read_sample
from analysis.data.selection import (
    Entry,
    Selection,
    environment_rank,
    labelled,
    labels_of,
    one_each,
    one_world,
    policy_rank,
    section_text,
    unfinished,
    why_impossible,
)
from analysis.figures.panels import (
    GUIDE,
    MARKERS,
    Plot,
    blank,
    half_widths,
    legend_below,
    log_scale,
    look,
    mark_break,
    rows_and_columns,
    shade,
    sheet,
)
from analysis.stats.curves import (
    STUDENT_RANGE,
    Axis,
    Limits,
    LossCurve,
    PlotOptions,
    Spread,
    axis_parts,
    geometric_mean,
    log_limits,
    measure_curves,
    tabulate_curves,
)
from analysis.stats.scores import final_losses, on_front, values_of
from analysis.style import (
    BLACK,
    GREY,
    SEQUENCE,
    LineStyle,
    count_text,
    environment_title,
    loss_unit,
    policy_style,
)
from dopt.policies import policy_title
from dopt.spec.trial import system_of
from orchestrate.store import Reader

CURVES_HEIGHT = 2.3

LONGEST_LABEL = 26
"""Letters of a line of the label of losses that are not longer than the axis of a broken panel."""

PLACES = {"loss": "grid", "reachable_loss": "reachable set"}
"""Points at which the error of the model is evaluated, by column of a step."""

BARS = 12
"""Steps at which error bars are drawn."""

_SPREADS = {Spread.BAND: "bands", Spread.ERRORBAR: f"bars at {BARS} steps"}
Curves = tuple[str, PlotOptions, tuple[LossCurve, ...]]


def loss_plot(column: str) -> Plot[Curves]:
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
        draw=draw_curves,
        caption=curves_caption,
    )


def draw_curves(numbers: Curves) -> Figure:
    """Draw one panel for each environment with a legend below all."""
    column, options, curves = numbers
    envs = list(dict.fromkeys(curve.env for curve in curves))
    rows, columns = rows_and_columns(len(envs), 2)
    figure = blank(columns, CURVES_HEIGHT * rows + 0.75)
    grid = figure.add_gridspec(rows, columns)
    unit = "steps" if options.axis is Axis.STEPS else "s"
    for index, env in enumerate(envs):
        shown = [curve for curve in curves if curve.env == env]
        panel = _curves_panel(
            figure, grid[index], shown, options.spread, list(_absent(curves, env))
        )
        if index + columns >= len(envs):
            panel[-1].set_xlabel(f"time t [{unit}]")
        label = loss_label(column, shown[0].unit, shown[0].is_prequential)
        panel[0].set_ylabel(label if len(label) <= LONGEST_LABEL else label.replace(" [", "\n["))
    ordered = sorted(curves, key=lambda curve: policy_rank(curve.policy))
    handles = legend_handles({curve.label: curve.style for curve in ordered}, options)
    legend_below(figure, 4 if columns > 1 else 2, handles=handles)
    return figure


def _curves_panel(
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
    counts = {curve.label: curve.count for curve in curves}
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
    name = options.statistic.band
    if options.spread is Spread.BAND:
        return [*handles, Patch(color=GREY, alpha=0.35, lw=0, label=name)]
    return [*handles, Line2D([], [], ls="none", marker="|", ms=9, mew=1, color=GREY, label=name)]


def curves_caption(numbers: Curves) -> str:
    """Return the caption, with the statistic, the band, n and what becomes of diverged trials."""
    column, options, curves = numbers
    counts = [
        f"{environment_title(env)} "
        + count_text({c.label: c.count for c in curves if c.env == env})
        for env in dict.fromkeys(c.env for c in curves)
    ]
    envs = dict.fromkeys(curve.env for curve in curves)
    absent = [f" No line: {why}." for env in envs for why in _absent(curves, env).values()]
    return (
        f"{_what(column, curves)} against time t, one panel per environment. "
        f"Lines: {options.statistic.label} over trials; {_SPREADS[options.spread]}: "
        f"{options.statistic.band}; no smoothing. {_breaks(curves)}"
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


FEWEST = 2
"""Configurations of an environment from which they are compared."""

PANEL_HEIGHT = 3.2

LEGEND_ROW = 0.16
LEGEND_COLUMNS = 3


def pareto_part(selection: Selection) -> Selection:
    """Return all configurations of the environments that have several, without the oracle's."""
    kept: list[Entry] = []
    for _, group in itertools.groupby(
        sorted(selection.stored, key=lambda one: environment_rank(one.config.env)),
        key=lambda one: one.config.env,
    ):
        finished = [one for one in group if one.finished and one.config.policy != APART]
        world = one_world(one_world(finished), "limits") if finished else []
        own = one_each(world)
        kept += own if len(own) >= FEWEST else []
    entries = tuple(labelled(kept))
    return Selection(entries, notes=tuple(unfinished(entries)))


def measure_points(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return a row for each configuration of an environment, ordered by time within it.

    ``label``: settings that differ among the configurations of the environment; ``policy_label``
    and ``learner_label``: policy and learner with their settings that differ, the learner's
    followed by the model, where it is another one than the network. ``us_per_step``: microseconds
    of planning and learning in a step, mean over the steps of a trial, median over trials that did
    not diverge. ``loss``, ``low``, ``high``: final loss, geometric mean over trials with its
    interval, in ``unit``. Both are NaN where no trial is left; the point is then not ``known``.
    ``n``: trials in the loss; ``counts``: these and those that diverged, as a text. ``limit_us``:
    time between two steps, dt [µs]. ``on_front``: no other configuration of the environment has a
    lower loss in a step that is as fast, or the same loss in a faster one.
    """
    policies = section_words(selection.entries, "policy")
    learners = learner_words(selection.entries)
    rows = []
    for entry, learner in zip(selection.entries, learners, strict=True):
        scores = final_losses(reader, entry, "loss")
        system, loss = system_of(entry.config.config), geometric_mean(values_of(scores))
        row: dict[str, Any] = {
            "env": entry.config.env,
            "label": entry.label,
            "policy": entry.config.policy,
        }
        row |= {"policy_label": policies[section_text(entry, "policy")], "learner_label": learner}
        row |= {"us_per_step": step_us(reader, entry)}
        row |= {"loss": loss.value, "low": loss.low, "high": loss.high, "unit": loss_unit(system)}
        row |= {"n": len(scores), "n_diverged": entry.n_diverged}
        rows.append(row | {"counts": entry.describe(len(scores)), "limit_us": 1e6 * system.dt})
    table = pd.DataFrame(rows)
    costs = table[["us_per_step", "loss"]]
    front = np.zeros(len(table), dtype=bool)
    for env in selection.environments:
        own = (table["env"] == env).to_numpy()
        front[own] = on_front(costs.to_numpy()[own])
    table["on_front"] = front
    table["known"] = np.isfinite(costs.to_numpy(float)).all(axis=1)
    place = table["env"].map(selection.environments.index)
    order = np.lexsort((table["us_per_step"], ~table["known"], place))
    return table.iloc[order].reset_index(drop=True)


def learner_words(entries: Sequence[Entry]) -> list[str]:
    """Return the words of the learner of each entry, and of a model that is not the usual one."""
    learners, models = (section_words(entries, name) for name in ("learner", "model"))
    beside = {one: f", {words}" for one, words in models.items() if words != USUAL["model"]}
    beside = beside if len(models) > 1 else {}
    return [
        learners[section_text(entry, "learner")] + beside.get(section_text(entry, "model"), "")
        for entry in entries
    ]


def section_words(entries: Sequence[Entry], section: str) -> dict[str, str]:
    """Return words for each section, as JSON: what differs from the defaults, else its name.

    They are the words of labels of configurations that differ in this section alone.
    """
    first = {section_text(entry, section): entry.config for entry in entries}
    rest = {key: own for key, own in entries[0].config.config.items() if key != "limits"}
    alike = [
        replace(config, config={**rest, section: config.config[section]})
        for config in first.values()
    ]
    if section == "policy":
        return dict(zip(first, labels_of(alike), strict=True))
    title = policy_title(str(rest["policy"]["name"]))
    return {
        text: str(one.config[section]["name"]) if words == title else words
        for (text, one), words in zip(first.items(), labels_of(alike), strict=True)
    }


def step_us(reader: Reader, entry: Entry) -> float:
    """Return the microseconds of planning and learning in a step, NaN without a whole trial.

    The mean over the steps of a trial counts what is done in some of them only, such as the fit of
    every tenth step; the median over trials leaves out those that the machine held up.
    """
    plan, learn = (read_sample(reader, entry, column).values for column in ("plan_us", "learn_us"))
    return float(np.median(np.mean(plan + learn, axis=1))) if len(plan) else float("nan")


def policies_of(points: pd.DataFrame) -> dict[str, str]:
    """Return the words of the policies with their names, in the order of the titles."""
    found = dict(zip(points["policy_label"], points["policy"], strict=True))
    return dict(sorted(found.items(), key=lambda one: (policy_rank(one[1]), len(one[0]), one[0])))


def draw(points: pd.DataFrame) -> Figure:
    """Draw a panel for each environment, with a legend of policies and learners below all."""
    parts = [part for _, part in points.groupby("env", sort=False)]
    colours = policy_colours(policies_of(points))
    markers = dict(zip(sorted(set(points["learner_label"])), itertools.cycle(MARKERS)))
    handles = _handles(points, colours, markers)
    rows, columns = rows_and_columns(len(parts), 2)
    legend = LEGEND_ROW * math.ceil(len(handles) / LEGEND_COLUMNS)
    figure, panels = sheet(rows, columns, PANEL_HEIGHT, legend)
    for axes, part in zip(panels.flat, parts, strict=False):
        _panel(axes, part, colours, markers)
    for axes in panels.flat[len(parts) :]:
        axes.remove()
    legend_below(figure, LEGEND_COLUMNS, handles=handles, fontsize=6.5, handlelength=1.2)
    return figure


def policy_colours(policies: Mapping[str, str]) -> dict[str, str]:
    """Return a colour for the words of each policy: its own, or a free one where that is taken.

    Colours of lines repeat, since dashes tell lines apart; colours of points must not. Grey is left
    where there are more policies than colours.
    """
    found: dict[str, str] = {}
    for words, policy in policies.items():
        own = policy_style(policy).colour
        if own not in found.values():
            found[words] = own
    free = (colour for colour in SEQUENCE if colour not in found.values())
    return {words: found.get(words) or next(free, GREY) for words in policies}


def _panel(
    axes: Axes, points: pd.DataFrame, colours: Mapping[str, str], markers: Mapping[str, str]
) -> None:
    known = points[points["known"]]
    for point in known.itertuples():
        _dot(axes, point, colours[str(point.policy_label)], markers[str(point.learner_label)])
    _limits(axes, known)
    front = known[known["on_front"]]
    if len(front):  # as steps
        times, losses = front["us_per_step"].tolist(), front["loss"].tolist()
        steps = ([times[0], *times, axes.get_xlim()[1]], [axes.get_ylim()[1], *losses, losses[-1]])
        axes.plot(*steps, drawstyle="steps-post", color=BLACK, lw=0.7, zorder=2)
    usual, env = _counts(points).partition(";")[0], points["env"].iloc[0]
    axes.set_title(f"{environment_title(env)} ({usual}, {len(points)} configurations)")
    axes.set_xlabel("planning and learning in a step [µs]")
    axes.set_ylabel(f"final {loss_label('loss', points['unit'].iloc[0])}")


def _dot(axes: Axes, point: Any, colour: str, marker: str) -> None:
    ends = half_widths([point.loss], [point.low], [point.high])
    face = "white" if point.n_diverged else colour
    axes.errorbar(
        point.us_per_step, point.loss, yerr=ends, fmt=marker, ms=4.2 if point.on_front else 3.4,
        color=colour, mfc=face, mec=BLACK if point.on_front else colour, mew=0.6, elinewidth=0.6,
        alpha=1.0 if point.on_front else 0.6, zorder=4 if point.on_front else 3,
    )  # fmt: skip


def _limits(axes: Axes, known: pd.DataFrame) -> None:
    """Set logarithmic axes around all points, and mark the time between two steps."""
    left, right = log_limits(known["us_per_step"].to_numpy(), margin=1.6)
    log_scale(axes, left, right, "x")
    log_scale(axes, *log_limits(known[["loss", "low", "high"]].to_numpy().ravel(), margin=1.3))
    limit = known["limit_us"].iloc[0] if len(known) else math.nan
    if left < limit < right:
        axes.axvline(limit, **GUIDE)
        axes.annotate(
            f"dt = {limit / 1e3:g} ms", (limit, 1), xycoords=("data", "axes fraction"),
            xytext=(-2, -2), textcoords="offset points", rotation=90, ha="right", va="top",
            fontsize=6,
        )  # fmt: skip


def _handles(
    points: pd.DataFrame, colours: Mapping[str, str], markers: Mapping[str, str]
) -> list[Line2D]:
    dots: list[tuple[str, dict[str, Any]]] = [
        ("o", {"color": colour, "label": words}) for words, colour in colours.items()
    ]
    dots += [(marker, {"color": GREY, "label": words}) for words, marker in markers.items()]
    if (points["known"] & (points["n_diverged"] > 0)).any():
        dots.append(("o", {"color": GREY, "mfc": "white", "label": "some trials diverged"}))
    handles = [Line2D([], [], ls="", marker=marker, ms=4, **look) for marker, look in dots]
    return [*handles, Line2D([], [], color=BLACK, lw=0.7, label="Pareto front")]


def caption(points: pd.DataFrame) -> str:
    """Return the caption, with what a point is, n and the configurations without a point."""
    counts = "; ".join(
        f"{environment_title(str(env))}: {_counts(part)}"
        for env, part in points.groupby("env", sort=False)
    )
    return (
        "Root mean square error of the model over the evaluation grid after the last step, against "
        "the time that planning and learning take in a step, both on logarithmic axes. A point is "
        "a configuration; colours are policies, markers learners; the oracle is left out. Loss: "
        f"geometric mean over trials with its 95 % interval (BCa bootstrap, {STUDENT_RANGE} "
        "trials). Time: mean over the steps of a trial, median over trials. Line: Pareto front; "
        "no configuration is both as good and as fast as one on it, and better in one of the two. "
        "Dashed, where it is in range: the time between two steps, dt. Open markers: some "
        f"trials diverged; a diverged trial counts in none of its numbers. {_missing(points)}"
        f"Trials: {counts}."
    )


def _counts(points: pd.DataFrame) -> str:
    known = points[points["known"]]
    return count_text(dict(zip(known["label"], known["counts"], strict=True)))


def _missing(points: pd.DataFrame) -> str:
    """Return which configurations have no point, or nothing."""
    lost = "; ".join(
        f"{environment_title(str(one.env))}, {one.label} ({one.counts})"
        for one in points[~points["known"]].itertuples()
    )
    return f"No point, as no trial has a positive final loss: {lost}. " if lost else ""


PARETO: Plot[pd.DataFrame] = Plot(
    title="Final loss against the time of a step",
    statistic="geometric mean over trials of the final loss; median over trials of the mean "
    "microseconds of planning and learning in a step",
    band=f"95 % interval of the mean logarithm (BCa bootstrap, {STUDENT_RANGE} trials)",
    part=lambda selection, _: pareto_part(selection),
    measure=lambda reader, selection, _: measure_points(reader, selection),
    tabulate=lambda points: points.drop(columns=["unit", "counts", "limit_us", "known"]),
    draw=draw,
    caption=caption,
)
"""Final loss against the time of a step, with the Pareto front."""
