"""Figure 6 as numbers: final loss and time of a step of every configuration, and the Pareto front.

A configuration is a policy, a model and a learner with all their settings. Environments are
compared in one env section and under one section of limits each, those of most trials.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from analysis.data.config_matching import APART
from analysis.data.curves import read_sample
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import (
    Entry,
    Selection,
    environment_rank,
    labelled,
    labels_of,
    policy_rank,
)
from analysis.data.variants import number_of_trials, one_each, one_world, section_text, unfinished
from analysis.stats.geometric_means import Estimate, geometric_mean
from analysis.stats.pareto import on_front
from analysis.stats.trial_scores import final_losses
from analysis.units import loss_unit
from dopt.spec.prequential import system_of
from orchestrate.store import Reader

USUAL = "mlp"
"""Model that goes without saying."""

FEWEST = 2
"""Configurations of an environment from which they are compared."""


@dataclass(frozen=True)
class Point:
    """One configuration in one environment.

    Attributes
    ----------
    label : str
        Settings that differ among the configurations of the environment.
    policy, policy_words, learner_words : str
        Name of the policy; the policy and the learner with those of their settings that differ. The
        learner's are followed by the model, where it is another one than the network.
    us : float
        Microseconds of planning and learning in a step: mean over the steps of a trial, median over
        trials that did not diverge; NaN without any.
    loss : Estimate
        Final loss, geometric mean over trials, in ``unit``; NaN where none is left.
    n, n_finished, n_diverged : int
        Trials in the loss, those that ended and those of them that diverged.
    counts : str
        These numbers as a text.
    limit_us : float
        Time between two steps, dt [µs].
    on_front : bool
        No other configuration of the environment has a lower loss in a step that is as fast, or
        the same loss in a faster one.
    """

    env: str
    label: str
    policy: str
    policy_words: str
    learner_words: str
    us: float
    loss: Estimate
    unit: str
    n: int
    n_finished: int
    n_diverged: int
    counts: str
    limit_us: float
    on_front: bool = False

    @property
    def known(self) -> bool:
        """Whether it can be drawn."""
        return bool(np.isfinite(self.us) and np.isfinite(self.loss.value))


Points = tuple[Point, ...]


def pareto_part(selection: Selection) -> Selection:
    """Return all configurations of the environments that have several, without the oracle's."""
    kept: list[Entry] = []
    for _, group in itertools.groupby(
        sorted(selection.stored, key=lambda one: environment_rank(one.config.env)),
        key=lambda one: one.config.env,
    ):
        finished = [one for one in group if one.finished and one.config.policy != APART]
        world = one_world(one_world(finished), "limits") if finished else []
        own = one_each(world, number_of_trials)
        kept += own if len(own) >= FEWEST else []
    entries = tuple(labelled(kept))
    return Selection(entries, notes=tuple(unfinished(entries)))


def measure_points(reader: Reader, selection: Selection, rule: DivergenceRule) -> Points:
    """Return a point for each entry, those of an environment by their time."""
    policies = section_words(selection.entries, "policy")
    learners = learner_words(selection.entries)
    points = [
        _point(reader, entry, policies[section_text(entry, "policy")], learner, rule)
        for entry, learner in zip(selection.entries, learners, strict=True)
    ]
    return tuple(
        point
        for env in selection.environments
        for point in _with_front([one for one in points if one.env == env])
    )


def learner_words(entries: Sequence[Entry]) -> list[str]:
    """Return the words of the learner of each entry, and of a model that is not the network."""
    learners, models = (section_words(entries, name) for name in ("learner", "model"))
    several = len({entry.config.model for entry in entries}) > 1
    return [
        learners[section_text(entry, "learner")]
        + (f", {models[section_text(entry, 'model')]}" if several and model != USUAL else "")
        for entry, model in ((entry, entry.config.model) for entry in entries)
    ]


def section_words(entries: Sequence[Entry], section: str) -> dict[str, str]:
    """Return for each section, as JSON, its name with the settings that differ.

    They are the words of labels of configurations that differ in this section alone.
    """
    first = {section_text(entry, section): entry.config for entry in entries}
    rest = {key: own for key, own in entries[0].config.config.items() if key != "limits"}
    alike = [
        replace(config, config={**rest, section: config.config[section]})
        for config in first.values()
    ]
    names = [str(config.config[section]["name"]) for config in first.values()]
    words = labels_of(alike) if len(alike) > 1 or section == "policy" else names
    return dict(zip(first, words, strict=True))


def _point(reader: Reader, entry: Entry, policy: str, learner: str, rule: DivergenceRule) -> Point:
    scores = final_losses(reader, entry, "loss", rule)
    system = system_of(entry.config.config)
    return Point(
        env=entry.config.env,
        label=entry.label,
        policy=entry.config.policy,
        policy_words=policy,
        learner_words=learner,
        us=step_us(reader, entry),
        loss=geometric_mean(scores.values),
        unit=loss_unit(system),
        n=len(scores.by_seed),
        n_finished=scores.n_finished,
        n_diverged=scores.n_diverged,
        counts=scores.describe(),
        limit_us=1e6 * system.dt,
    )


def step_us(reader: Reader, entry: Entry) -> float:
    """Return the microseconds of planning and learning in a step, NaN without a whole trial.

    The mean over the steps of a trial counts what is done in some of them only, such as the fit of
    every tenth step; the median over trials leaves out those that the machine held up.
    """
    plan, learn = (
        read_sample(reader, entry, column, DivergenceRule.EXCLUDE).values
        for column in ("plan_us", "learn_us")
    )
    return float(np.median(np.mean(plan + learn, axis=1))) if len(plan) else float("nan")


def _with_front(points: Sequence[Point]) -> Iterator[Point]:
    """Yield the points of an environment by their time, with their place on the front."""
    front = on_front(np.array([(point.us, point.loss.value) for point in points]))
    placed = [replace(one, on_front=bool(is_on)) for one, is_on in zip(points, front, strict=True)]
    yield from sorted(placed, key=lambda one: (not one.known, one.us))


def policies_of(points: Points) -> dict[str, str]:
    """Return the words of the policies with their names, in the order of the titles."""
    found = {point.policy_words: point.policy for point in points}
    return dict(sorted(found.items(), key=lambda one: (policy_rank(one[1]), len(one[0]), one[0])))


def learners_of(points: Points) -> tuple[str, ...]:
    """Return the words of the learners by name."""
    return tuple(sorted({point.learner_words for point in points}))


def tabulate_points(points: Points) -> pd.DataFrame:
    """Return what is drawn, one row for each environment and configuration."""
    return pd.DataFrame([_row(point) for point in points])


def _row(point: Point) -> Mapping[str, object]:
    return {
        "env": point.env,
        "label": point.label,
        "policy": point.policy,
        "policy_label": point.policy_words,
        "learner_label": point.learner_words,
        "us_per_step": point.us,
        "loss": point.loss.value,
        "low": point.loss.low,
        "high": point.loss.high,
        "n": point.n,
        "n_diverged": point.n_diverged,
        "on_front": point.on_front,
    }
