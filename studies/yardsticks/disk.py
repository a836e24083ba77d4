"""Error of the rate of an unbalanced disk that runs free: the disk of ActiveSysID, run here."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import Filter
from analysis.data.samples import learned_model
from analysis.data.selection import Entry, policy_rank
from analysis.style import within
from analysis.tables.rendering import TextTable
from dopt.assessment import model_forecast
from dopt.control.planning import forecast_by_equations
from dopt.limits import VIOLATIONS
from dopt.spec.trial import TrialSpec
from dopt.systems import System, UnbalancedDisk
from dopt.types import Array
from orchestrate.store import ConfigRow, Reader
from studies.yardsticks.common import (
    ACTIVE_SYSID,
    REFERENCE,
    distinct_entries,
    interval_columns,
    median,
    ratio_text,
    ratio_to_random,
)

NAME = "active_sysid"
ANGLE, RATE = 0, 1
"""Places among the states; the rate is measured."""

TARGET = min(ACTIVE_SYSID.values())
"""Lowest published error [rad/s]."""

TEST_SAMPLES = 2000
TEST_INPUTS = 0.05 * np.arange(-60, 60)
"""Voltages of the test run [V], of which each sample draws one."""

BOUND = 4.5
"""Largest rate [rad/s]."""

LIMITS = {False: "without limits", True: f"rate within {BOUND:g} rad/s"}
"""Names of the columns, by whether inputs heed the limits."""

_SEED = 20_250_626


def entries(reader: Reader, wanted: Filter) -> list[Entry]:
    """Return the configurations with the disk whose bounded rate alone is measured, with trials.

    Raises
    ------
    AnalysisError
        If two of them have the same policy and the same use of the limits.
    """
    return distinct_entries(
        reader, lambda one: _is_asked_for(one, wanted), _place, _words, "env.horizon=1000"
    )


def _is_asked_for(config: ConfigRow, wanted: Filter) -> bool:
    sections = config.config
    measured = sections["env"].get("measured_states") == [RATE]
    bounds = (sections.get("limits") or {}).get("bounds", {})
    fits = config.env == UnbalancedDisk.name and measured and bounds.get("ω") == [-BOUND, BOUND]
    return fits and wanted.accepts(config)


def _enforced(entry: Entry) -> bool:
    return bool(entry.config.config["limits"]["enforced"])


def _policy(entry: Entry) -> str:
    """Return the name of a row: the policy, or its criterion of space filling."""
    section = entry.config.config["policy"]
    return str(section["criterion"] if section["name"] == "space_filling" else section["name"])


def _place(entry: Entry) -> tuple[object, ...]:
    return _enforced(entry), policy_rank(entry.config.policy), _policy(entry)


def _words(entry: Entry) -> str:
    return f"of the disk {LIMITS[_enforced(entry)]} with the policy '{_policy(entry)}'"


def violation_shares(reader: Reader, entry: Entry) -> dict[int, float]:
    """Return the share of steps after which a bound is exceeded, by the seed of a finished trial.

    Steps before a trial diverged count. Trials without limits have none.
    """
    found = reader.assessments(entry.config.config_key, VIOLATIONS)
    values = found.values / np.maximum(found.t, 1)
    counted = dict(zip(found.seeds.tolist(), values, strict=True))
    rows = {one.seed: counted[one.seed] for one in entry.finished if one.seed in counted}
    finite = {seed: row[np.isfinite(row)] for seed, row in rows.items()}
    return {seed: float(row.sum()) for seed, row in finite.items() if len(row)}


def measure(reader: Reader, found: Iterable[Entry]) -> pd.DataFrame:
    """Return one row for each finished trial: the error of the rate in the test run [rad/s].

    The error is infinite where the trial or the prediction diverged. ``turned`` is the largest
    angle from hanging that the learner estimated [rad], and ``violations`` the share of the trial's
    steps after which the rate was beyond its bounds.
    """
    rows: list[dict[str, object]] = []
    for entry in found:
        shares = violation_shares(reader, entry)
        for trial in entry.finished:
            error, turned = np.inf, np.nan
            if trial.status == "done":
                model = learned_model(reader, entry.config, trial.seed)
                error = rate_error(model.spec, model.parameters)
                states = reader.trajectory(entry.config.config_key, trial.seed).states
                turned = float(np.abs(states[:, ANGLE]).max())
            row = {"enforced": _enforced(entry), "policy": _policy(entry), "seed": trial.seed}
            row |= {"error": error, "turned": turned, "violations": shares[trial.seed]}
            rows.append(row)
    return pd.DataFrame(rows)


def rate_error(spec: TrialSpec, parameters: Array) -> float:
    """Return the root mean square error of the model's rate in the test run [rad/s].

    The run starts at rest, each sample draws one of :data:`TEST_INPUTS`, and the rate is measured
    with the noise of the trial. The model predicts it from the first sample to the last without a
    measurement. Infinite where the prediction overflows.

    Parameters
    ----------
    spec : TrialSpec
        Trial of the disk.
    parameters : (q,)
        Learned parameters.
    """
    inputs, outputs = run_of_the_test(spec.system)
    forecast = model_forecast(spec.system, spec.model, parameters)
    predicted = forecast(np.zeros((1, spec.system.n_states)), inputs)[:, 0, RATE]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(np.mean((predicted - outputs) ** 2)))
    return error if np.isfinite(error) else np.inf


@functools.lru_cache(maxsize=4)
def run_of_the_test(system: System) -> tuple[Array, Array]:
    """Return the inputs, (1, N, 1), and the measured rates, (N,), of the test run."""
    rng = np.random.default_rng(_SEED)
    inputs = rng.choice(TEST_INPUTS, (1, TEST_SAMPLES, 1))
    rates = forecast_by_equations(system)(np.zeros((1, system.n_states)), inputs)[:, 0, RATE]
    noise = system.measurement_noise[0] * rng.standard_normal(TEST_SAMPLES)
    return inputs, rates + noise


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Return medians and ratios to random inputs, with intervals of 95 %, for each policy.

    ``ratio`` is the geometric mean of the ratio of errors to random inputs of the same seed,
    ``reached`` the number of trials with at most the lowest published error, ``turned`` the median
    of the largest angles, and ``violations`` the mean share of steps beyond the bounds.
    """
    rows = []
    for (enforced, policy), own in trials.groupby(["enforced", "policy"], sort=False):
        values = own.error.to_numpy(float)
        row: dict[str, object] = {"enforced": enforced, "policy": policy, "n": len(values)}
        row["reached"] = int(np.sum(values <= TARGET))
        row["turned"] = float(own.turned.median())
        row["violations"] = float(own.violations.mean())
        row |= interval_columns("median", median(values, np.random.default_rng(_SEED)))
        alike = trials[trials.enforced == enforced]
        question = f"unbalanced_disk/{LIMITS[bool(enforced)]}"
        ratio = ratio_to_random(alike, str(policy), "error", question)
        rows.append(row | interval_columns("ratio", ratio))
    return pd.DataFrame(rows)


def tables(table: pd.DataFrame) -> tuple[TextTable, TextTable]:
    """Return the errors of all policies beside the published ones, and their ratios."""
    return _error_table(table), _ratio_table(table)


def _error_table(table: pd.DataFrame) -> TextTable:
    kinds = _kinds(table)
    rows = _rows(table, kinds, _error_text)
    for policy, error in ACTIVE_SYSID.items():
        rows.append([f"published: {policy}", *(f"{error:g}" if kind else "–" for kind in kinds)])
    note = (
        f"Root mean square error of the rate in the test run [rad/s]: median over the trials "
        f"[interval of 95 %]; trials with at most {TARGET:g} rad/s; steps of the exploration after "
        f"which the rate was beyond {BOUND:g} rad/s. Published: mean after twice as many samples."
    )
    return TextTable(["policy", *map(LIMITS.__getitem__, kinds)], rows, note)


def _ratio_table(table: pd.DataFrame) -> TextTable:
    kinds = _kinds(table)
    rows = _rows(table[table.policy != REFERENCE], kinds, ratio_text)
    note = "Ratio of errors to random inputs: paired geometric mean [interval of 95 %]."
    return TextTable(["policy", *map(LIMITS.__getitem__, kinds)], rows, note)


def _kinds(table: pd.DataFrame) -> list[bool]:
    return [bool(kind) for kind in dict.fromkeys(table.enforced)]


def _rows(
    table: pd.DataFrame, kinds: Sequence[bool], text: Callable[[Mapping[Hashable, Any]], str]
) -> list[list[str]]:
    """Return a row for each policy, with a cell for each use of the limits."""
    rows = []
    for policy, own in table.groupby("policy", sort=False):
        cells = {bool(row["enforced"]): text(row) for row in own.to_dict("records")}
        rows.append([str(policy), *(cells.get(kind, "–") for kind in kinds)])
    return rows


def _error_text(row: Mapping[Hashable, Any]) -> str:
    shown = within(row["median"], row["median_low"], row["median_high"])
    return f"{shown}; {row['reached']} of {row['n']}; {100 * row['violations']:.1f} %"
