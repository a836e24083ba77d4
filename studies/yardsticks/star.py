"""Distance to a star that moves, after one of its turns: Figure 4 of FLEX, run here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import Filter
from analysis.data.samples import learned_model
from analysis.data.selection import Entry, policy_rank
from analysis.style import within
from analysis.tables.rendering import TextTable
from dopt.assessment import parameter_error
from dopt.models import GreyBox
from dopt.systems import MovingStar, System
from dopt.types import Array
from orchestrate.store import ConfigRow, Reader
from studies.yardsticks.common import (
    FLEX_STAR,
    REFERENCE,
    distinct_entries,
    interval_columns,
    median,
    ratio_text,
    ratio_to_random,
)

NAME = "flex_star"
CENTRE = ("center_x", "center_y")
LOST = 0.5
"""Error above which a star is lost [m²]: at a distance of 1 m, twice its radius."""

_SEED = 20_230_426


def entries(reader: Reader, wanted: Filter) -> list[Entry]:
    """Return the configurations with the moving star and its centre unknown, and their trials.

    Raises
    ------
    AnalysisError
        If two of them have the same policy and learner.
    """
    return distinct_entries(
        reader, lambda one: _is_asked_for(one, wanted), _place, _words, "policy.regularization=1e-7"
    )


def _is_asked_for(config: ConfigRow, wanted: Filter) -> bool:
    fits = config.env == MovingStar.name and config.model == GreyBox.name
    return fits and config.config["model"]["unknown"] == list(CENTRE) and wanted.accepts(config)


def _names(entry: Entry) -> tuple[str, str]:
    return _learner(entry), entry.config.policy


def _learner(entry: Entry) -> str:
    """Return the name of a column: the learner, with the rate of one by gradients."""
    section = entry.config.config["learner"]
    rate = section.get("learning_rate")
    return str(section["name"]) if rate is None else f"{section['name']}, rate {rate:g}"


def _place(entry: Entry) -> tuple[object, ...]:
    return _learner(entry), policy_rank(entry.config.policy)


def _words(entry: Entry) -> str:
    learner, policy = _names(entry)
    return f"of the moving star with the policy '{policy}' and the learner '{learner}'"


def measure(reader: Reader, found: Iterable[Entry]) -> pd.DataFrame:
    """Return one row for each finished trial: half the squared error of the centre [m²].

    The error is that against the centre at the last step. It is infinite where the trial diverged.
    ``apart`` is the distance between mass and star [m], its median over the steps.
    """
    rows: list[dict[str, object]] = []
    for entry in found:
        for trial in entry.finished:
            error, apart = np.inf, np.nan
            if trial.status == "done":
                model = learned_model(reader, entry.config, trial.seed)
                system = model.spec.system
                error = parameter_error(system, model.parameters, system.horizon - 1, CENTRE)
                states = reader.trajectory(entry.config.config_key, trial.seed).states
                apart = _median_distance(system, states)
            learner, policy = _names(entry)
            row = {"learner": learner, "policy": policy, "seed": trial.seed}
            rows.append(row | {"error": 0.5 * error**2, "apart": apart})
    return pd.DataFrame(rows)


def _median_distance(system: System, states: Array) -> float:
    places = [system.physical.index(name) for name in CENTRE]
    apart = np.linalg.norm(states[:-1] - system.history[:, places], axis=1)
    return float(np.median(apart))


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Return medians, numbers of lost stars and ratios to random inputs, with intervals of 95 %.

    One row for each learner and policy. ``ratio`` is the geometric mean of the ratio of errors
    to random inputs of the same seed and learner, ``apart`` the median distance over the trials,
    and ``lost`` counts the errors above :data:`LOST`.
    """
    rows = []
    for (learner, policy), own in trials.groupby(["learner", "policy"], sort=False):
        values = own.error.to_numpy(float)
        row: dict[str, object] = {"learner": learner, "policy": policy, "n": len(values)}
        row["apart"] = float(own.apart.median())
        row["lost"] = int(np.sum(values > LOST))
        row |= interval_columns("median", median(values, np.random.default_rng(_SEED)))
        taught = trials[trials.learner == learner]
        ratio = ratio_to_random(taught, str(policy), "error", f"moving_star/{learner}")
        rows.append(row | interval_columns("ratio", ratio))
    return pd.DataFrame(rows)


def tables(table: pd.DataFrame) -> tuple[TextTable, TextTable]:
    """Return the errors of all policies beside the published ones, and their ratios."""
    return _error_table(table), _ratio_table(table)


def _error_table(table: pd.DataFrame) -> TextTable:
    learners = list(dict.fromkeys(table.learner))
    rows = [
        [policy, *(_cell(own, learner, _error_texts) for learner in learners)]
        for policy, own in table.groupby("policy", sort=False)
    ]
    rows += [
        [f"published: {policy}", *_beside(learners, text)] for policy, text in FLEX_STAR.items()
    ]
    note = (
        "Half the squared distance between the learned and the true centre of the star at the last "
        "step [m²]: median over the trials [interval of 95 %]; trials that end 1 m off or farther."
    )
    return TextTable(["policy", *learners], rows, note)


def _beside(learners: Sequence[str], published: str) -> list[str]:
    """Return a published error in the first column, whose learner and rate are theirs."""
    return [published, *["–"] * (len(learners) - 1)]


def _ratio_table(table: pd.DataFrame) -> TextTable:
    learners = list(dict.fromkeys(table.learner))
    rows = [
        [policy, *(_cell(own, learner, ratio_text) for learner in learners)]
        for policy, own in table.groupby("policy", sort=False)
        if policy != REFERENCE
    ]
    note = "Ratio of errors to random inputs: paired geometric mean [interval of 95 %]."
    return TextTable(["policy", *learners], rows, note)


def _cell(own: pd.DataFrame, learner: str, text: Callable[[Mapping[Hashable, Any]], str]) -> str:
    rows = own[own.learner == learner].to_dict("records")
    return text(rows[0]) if rows else "–"


def _error_texts(row: Mapping[Hashable, Any]) -> str:
    shown = within(row["median"], row["median_low"], row["median_high"])
    return f"{shown}; {row['lost']}"
