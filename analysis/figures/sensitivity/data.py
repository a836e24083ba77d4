"""Figure 8 as numbers: final loss against one setting at a time, all others as in a base.

The base of a policy in an environment is the configuration from which most others differ in one of
the settings alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from analysis.data.config_matching import nearness
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry, Selection
from analysis.data.variants import one_each, one_world, unfinished
from analysis.stats.geometric_means import Estimate, geometric_mean
from analysis.stats.trial_scores import Scores, final_losses
from analysis.units import loss_unit
from dopt.spec.label import flatten
from dopt.spec.prequential import system_of
from orchestrate.store import Reader

SETTINGS = ("policy.regularization", "learner.learning_rate", "learner.window")

FEWEST = 3
"""Values of a setting from which they are a line."""

_TASK = ("task", "assessment_version")
"""Beginnings of paths of which no loss depends."""

Family = tuple[Entry, dict[str, list[Entry]]]
"""A base, and by setting the entries that differ from it in this one alone, with the base."""


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
    a, b = flatten(one.config.config), flatten(other.config.config)
    paths = {path for path in a.keys() | b.keys() if a.get(path) != b.get(path)}
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
