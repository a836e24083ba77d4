"""Figure 8: final loss against single settings, a row for each environment.

The base of a policy in an environment is the configuration from which most others differ in one of
the settings alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.matching import differing_paths, nearness
from analysis.data.samples import DivergenceRule
from analysis.data.selection import Entry, Selection, one_each, one_world, policy_rank, unfinished
from analysis.figures.panels import (
    GUIDE,
    Plot,
    half_widths,
    legend_below,
    log_scale,
    look,
    sheet,
    value_ticks,
)
from analysis.stats.curves import log_limits
from analysis.stats.intervals import STUDENT_RANGE, Estimate, geometric_mean
from analysis.stats.scores import Scores, final_losses
from analysis.style import (
    count_text,
    environment_title,
    loss_unit,
    policy_style,
    text_by_environment,
)
from dopt.policies import policy_title
from dopt.spec.label import flatten, value_label
from dopt.spec.trial import system_of
from orchestrate.store import Reader

SETTINGS = ("policy.regularization", "learner.learning_rate", "learner.window")

FEWEST = 3
"""Values of a setting from which they are a line."""

_TASK = ("task", "assess")
"""Beginnings of paths of which no loss depends."""

Family = tuple[Entry, dict[str, list[Entry]]]
"""A base, and by setting the entries that differ from it in this one alone, with the base."""

ROW_HEIGHT = 1.45
AROUND = 0.7

NAMES = {
    "policy.regularization": "λ of the information matrix",
    "learner.learning_rate": "learning rate",
    "learner.window": "window [samples]",
}


@dataclass(frozen=True)
class Line:
    """Final losses of a policy in an environment against a setting, the V values ascending.

    Attributes
    ----------
    values : tuple of float
        Of the setting; empty for a policy that does not have it, whose only loss is its base's.
    usual : float
        Value of the base, NaN for a policy that does not have the setting.
    losses : tuple of Estimate
        Geometric means over trials, in ``unit``; one for each value.
    scores : tuple of Scores
        The trials that they are of.
    """

    env: str
    policy: str
    setting: str
    values: tuple[float, ...]
    usual: float
    losses: tuple[Estimate, ...]
    scores: tuple[Scores, ...]
    unit: str


def sensitivity_part(selection: Selection) -> Selection:
    """Return the bases and what differs from them in one setting alone."""
    found = [
        entry
        for base, lines in families(selection.stored)
        for entry in (base, *(one for line in lines.values() for one in line))
    ]
    entries = tuple({entry.config.config_key: entry for entry in found}.values())
    return Selection(entries, notes=tuple(unfinished(entries)))


def families(entries: Sequence[Entry]) -> list[Family]:
    """Return the base and the lines of each environment and policy that has a line."""
    found = []
    for env in dict.fromkeys(entry.config.env for entry in entries):
        own = [one for one in entries if one.config.env == env and one.finished]
        kept = one_each(one_world(own)) if own else []
        for policy in dict.fromkeys(entry.config.policy for entry in kept):
            same = [one for one in kept if one.config.policy == policy]
            family = max(((base, _lines(base, same)) for base in same), key=_rank)
            found += [family] if family[1] else []
    return found


def _lines(base: Entry, entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    lines = {}
    for setting in SETTINGS:
        line = [one for one in entries if _differences(one, base) <= {setting}]
        if len(line) >= FEWEST:
            lines[setting] = sorted(line, key=lambda one: _value(one, setting))
    return lines


def _differences(one: Entry, other: Entry) -> set[str]:
    paths = differing_paths([flatten(entry.config.config) for entry in (one, other)])
    return {path for path in paths if not path.startswith(_TASK)}


def _value(entry: Entry, setting: str) -> float:
    return float(str(flatten(entry.config.config).get(setting, "nan")))


def _rank(family: Family) -> tuple[int, ...]:
    base, lines = family
    return len(lines), sum(map(len, lines.values())), *nearness(base.config)


def measure_lines(reader: Reader, selection: Selection, rule: DivergenceRule) -> tuple[Line, ...]:
    """Return all lines, and a level for each policy that lacks a setting which others have."""
    found = families(selection.entries)
    settings = [one for one in SETTINGS if any(one in lines for _, lines in found)]
    return tuple(
        _measure(reader, base, setting, lines.get(setting, [base]), rule)
        for base, lines in found
        for setting in settings
    )


def _measure(
    reader: Reader, base: Entry, setting: str, line: list[Entry], rule: DivergenceRule
) -> Line:
    scores = tuple(final_losses(reader, one, "loss", rule) for one in line)
    return Line(
        env=base.config.env,
        policy=base.config.policy,
        setting=setting,
        values=tuple(_value(one, setting) for one in line) if len(line) > 1 else (),
        usual=_value(base, setting),
        losses=tuple(geometric_mean(one.values) for one in scores),
        scores=scores,
        unit=loss_unit(system_of(base.config.config)),
    )


def tabulate_lines(lines: tuple[Line, ...]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy, setting and value."""
    return pd.DataFrame([row for line in lines for row in _rows(line)])


def _rows(line: Line) -> Iterator[dict[str, object]]:
    values = line.values or (line.usual,)
    for value, loss, scores in zip(values, line.losses, line.scores, strict=True):
        yield {
            "env": line.env,
            "policy": line.policy,
            "setting": line.setting,
            "value": value,
            "loss": loss.value,
            "low": loss.low,
            "high": loss.high,
            "n": len(scores.by_seed),
            "n_diverged": scores.n_diverged,
        }


Lines = tuple[Line, ...]


def draw(lines: Lines) -> Figure:
    """Draw a row for each environment, a column for each setting, a line for each policy."""
    environments, settings, policies = (
        list(dict.fromkeys(getattr(line, name) for line in lines))
        for name in ("env", "setting", "policy")
    )
    rows, columns = len(environments), len(settings)
    figure, grid = sheet(rows, columns, ROW_HEIGHT, AROUND, sharex="col", sharey="row")
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
            axes.axhline(level.value, **look(style))
            axes.axhspan(level.low, level.high, color=style.colour, alpha=0.18, lw=0)
            continue
        y, low, high = np.array([(one.value, one.low, one.high) for one in line.losses]).T
        axes.errorbar(
            line.values, y, half_widths(y, low, high), marker="o", ms=3, elinewidth=0.7,
            capsize=1.5, **look(style),
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


SENSITIVITY: Plot[Lines] = Plot(
    title="Final loss against single settings",
    statistic="geometric mean over trials of the loss after the last step",
    band=f"95 % interval of the mean logarithm (BCa bootstrap, {STUDENT_RANGE} trials)",
    part=lambda selection, _: sensitivity_part(selection),
    measure=lambda reader, selection, options: measure_lines(reader, selection, options.rule),
    tabulate=tabulate_lines,
    draw=draw,
    caption=caption,
)
"""Final loss against λ, the learning rate and the window."""
