"""Samples until a planner with the learned model swings up: Table 1 of FLEX, run here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import Filter
from analysis.data.selection import Entry, environment_rank, policy_rank
from analysis.stats.scores import (
    benjamini_hochberg,
    compare_hitting_times,
    first_passage,
    last_passage,
)
from analysis.style import p_text, share, steps_text
from analysis.tables.comparisons import paired
from analysis.tables.rendering import TextTable
from dopt.systems import Cartpole, Pendulum
from dopt.types import Array
from orchestrate.store import Assessments, ConfigRow, Reader
from studies.yardsticks.common import (
    FLEX_SWING_UP,
    FLEX_SWING_UP_LONGEST,
    REFERENCE,
    distinct_entries,
    interval_columns,
    median,
)

NAME = "flex_table1"

COLUMN = ["env", "model"]
"""Settings that the trials of one column of the tables share."""

_SOLVERS = {"control_success": "", "feedback_success": ", its own feedback"}
"""Solvers of the task: a planner with the learned model, and what the policy itself has learned."""

_SEED = 20_230_426

Text = Callable[[Mapping[Hashable, Any]], str]


def entries(reader: Reader, wanted: Filter) -> list[Entry]:
    """Return the configurations that were assessed by a swing-up, and their trials.

    Raises
    ------
    AnalysisError
        If two of them have the same system, model and policy.
    """
    return distinct_entries(
        reader, lambda one: _is_asked_for(one, wanted), _place, _words, "learner.name=gauss_newton"
    )


def _is_asked_for(config: ConfigRow, wanted: Filter) -> bool:
    swung = config.env in (Pendulum.name, Cartpole.name)
    return swung and bool(config.config.get("task")) and wanted.accepts(config)


def _place(entry: Entry) -> tuple[object, ...]:
    """Return the place of an entry: by system, networks before the linear model, by policy."""
    config = entry.config
    linear = config.model == "linear"
    return environment_rank(config.env), linear, config.model, policy_rank(config.policy)


def _words(entry: Entry) -> str:
    config = entry.config
    return (
        f"of a swing-up with the system '{config.env}', the model '{config.model}' and the policy "
        f"'{config.policy}'"
    )


def measure(reader: Reader, found: Iterable[Entry]) -> pd.DataFrame:
    """Return one row for each finished trial: the explored samples that solve the swing-up.

    A trial whose policy learns the task itself has another one, for its own feedback.

    ``samples`` is the first assessed number of samples at which, and at all later ones, the episode
    succeeds; ``first`` the first one at which it succeeds. They are inf where the episode never
    succeeds, and where the trial diverged before. ``horizon`` is the last assessed number.
    """
    parts = []
    for entry in (one for one in found if one.finished):
        for measure, ending in _SOLVERS.items():
            solved = reader.assessments(entry.config.config_key, measure)
            if len(solved.t):
                parts.append(_measured(entry, solved, entry.config.policy + ending))
    table = pd.concat(parts, ignore_index=True)
    return table[[*COLUMN, "policy", "horizon", "seed", "samples", "first"]]


def _measured(entry: Entry, solved: Assessments, policy: str) -> pd.DataFrame:
    config = entry.config
    facts: dict[str, str | int] = {"env": config.env, "model": config.model}
    facts |= {"policy": policy, "horizon": config.horizon}
    own = pd.DataFrame(_samples(solved), index=solved.seeds)
    own = own.reindex([trial.seed for trial in entry.finished], fill_value=np.inf)
    return own.rename_axis("seed").reset_index().assign(**facts)


def _samples(solved: Assessments) -> dict[str, Array]:
    """Return the samples, (n,), after which the episodes succeed, by the names of the columns."""
    failed = 1.0 - solved.values
    steps = np.append(solved.t, np.inf)
    passages = {"samples": last_passage(failed, 0.0), "first": first_passage(failed, 0.0)}
    return {
        name: steps[np.minimum(places, len(steps)).astype(int) - 1]
        for name, places in passages.items()
    }


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Return medians with intervals of 95 %, and how often a policy needs fewer than random inputs.

    One row for each system, model and policy. ``improvement`` is the share of seeds with fewer
    samples than random inputs of the same seed, ties counted half, and ``p_adjusted`` the p-value
    of the sign test, adjusted over the table (Benjamini-Hochberg).
    """
    rows = []
    for _, column in trials.groupby(COLUMN, sort=False):
        for policy, own in column.groupby("policy", sort=False):
            row: dict[str, object] = {**own.iloc[0][COLUMN], "policy": policy, "n": len(own)}
            row["horizon"] = int(own.horizon.iloc[0])
            for name in ("samples", "first"):
                values = own[name].to_numpy(float)
                row |= interval_columns(name, median(values, np.random.default_rng(_SEED)))
                row[f"{name}_unsolved"] = int(np.isinf(values).sum())
            rows.append(row | _beside_random(column, str(policy)))
    table = pd.DataFrame(rows)
    table["p_adjusted"] = benjamini_hochberg(table.pop("p_value").tolist())
    return table


def _beside_random(column: pd.DataFrame, policy: str) -> dict[str, float]:
    by_policy = {
        str(one): dict(zip(part.seed, part.samples, strict=True))
        for one, part in column.groupby("policy")
    }
    reference = {} if policy == REFERENCE else by_policy.get(REFERENCE, {})
    found = compare_hitting_times(*paired(by_policy[policy], reference))
    return {"improvement": found.improvement, "p_value": found.p_value}


def tables(table: pd.DataFrame) -> tuple[TextTable, TextTable, TextTable]:
    """Return the samples of all policies beside the published ones, and the paired comparison."""
    return lasting_table(table), first_table(table), improvement_table(table)


def lasting_table(table: pd.DataFrame) -> TextTable:
    """Return the medians beside the published rows."""
    note = (
        "Samples until the swing-up is solved and stays solved: median over the trials [interval "
        "of 95 %]; trials in which it is not at the end."
    )
    header, rows = _rows(table, lambda row: _median_text(row, "samples"))
    for policy, samples in FLEX_SWING_UP.items():
        printed = [samples.get(names) for names in _columns(table)]
        texts = ["–" if n is None else steps_text(n, FLEX_SWING_UP_LONGEST) for n in printed]
        rows.append([f"published: {policy}", *texts])
    return TextTable(header, rows, note)


def first_table(table: pd.DataFrame) -> TextTable:
    """Return the medians of the samples at which the swing-up is first solved."""
    note = (
        "Samples until the swing-up is solved for the first time: median over the trials [interval "
        "of 95 %]; trials in which it never is."
    )
    return TextTable(*_rows(table, lambda row: _median_text(row, "first")), note)


def improvement_table(table: pd.DataFrame) -> TextTable:
    """Return the share of seeds with fewer samples than random inputs."""
    note = (
        "Share of seeds on which the swing-up is solved for good after fewer samples than with "
        "random inputs, ties counted half; adjusted p of the sign test."
    )
    return TextTable(*_rows(table[table.policy != REFERENCE], _improvement_text), note)


def _columns(table: pd.DataFrame) -> list[tuple[str, str]]:
    return list(dict.fromkeys(zip(table.env, table.model, strict=True)))


def _rows(table: pd.DataFrame, text: Text) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: one row for each policy, one column for each system and model."""
    cells = {
        (str(row["policy"]), (row["env"], row["model"])): text(row)
        for row in table.to_dict("records")
    }
    columns = _columns(table)
    policies = sorted(set(table.policy), key=policy_rank)
    rows = [[one, *(cells.get((one, names), "–") for names in columns)] for one in policies]
    return ["policy", *(", ".join(names) for names in columns)], rows


def _median_text(row: Mapping[Hashable, Any], name: str) -> str:
    centre, low, high = (
        steps_text(row[one], int(row["horizon"])) for one in (name, f"{name}_low", f"{name}_high")
    )
    return f"{centre} [{low}, {high}]; {row[f'{name}_unsolved']}"


def _improvement_text(row: Mapping[Hashable, Any]) -> str:
    return f"{share(row['improvement'])}; {p_text(row['p_adjusted'])}"
