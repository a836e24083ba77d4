"""Samples until the frictions of coupled pendulums are known: Table 3 of FLEX, run here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import Filter
from analysis.data.samples import read_curves
from analysis.data.selection import Entry, policy_rank
from analysis.stats.scores import last_passage
from analysis.style import steps_text, within
from analysis.tables.rendering import TextTable
from dopt.assessment import true_parameters
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models.linear import linear_terms
from dopt.spec.trial import system_of
from dopt.systems import CoupledPendulums, System
from orchestrate.store import ConfigRow, Reader
from studies.yardsticks.common import (
    FLEX_LONGEST,
    FLEX_SAMPLES,
    FLEX_SIZES,
    REFERENCE,
    distinct_entries,
    exponent,
    interval_columns,
    median,
    ratio_text,
    ratio_to_random,
    slopes,
)

NAME = "flex_table3"

ERROR = 1e-2
"""Euclidean norm of the error of the frictions [1/s] that is to be reached."""

TOLERANCE = 1e-9
"""Relative difference of two mean squares of regressors that counts as rounding."""

_SEED = 20_230_426


def entries(reader: Reader, wanted: Filter) -> list[Entry]:
    """Return the configurations with coupled pendulums and the linear model, and their trials.

    Raises
    ------
    AnalysisError
        If two of them have the same policy and number of pendulums.
    """
    return distinct_entries(
        reader, lambda one: _is_asked_for(one, wanted), _place, _words, "env.horizon=1000"
    )


def _is_asked_for(config: ConfigRow, wanted: Filter) -> bool:
    fits = config.env == CoupledPendulums.name and config.model == "linear"
    return fits and wanted.accepts(config)


def _size(entry: Entry) -> int:
    return int(entry.config.config["env"]["n_pendulums"])


def _place(entry: Entry) -> tuple[object, ...]:
    return policy_rank(entry.config.policy), _size(entry)


def _words(entry: Entry) -> str:
    return f"with {_size(entry)} pendulums and the policy '{entry.config.policy}'"


def loss_by_parameter_error(system: System) -> float:
    """Return c such that the loss of the linear model is c ‖θ - θ*‖₂ for every θ.

    The squared loss is (θ - θ*)ᵀ G (θ - θ*), with G the mean of ΨᵀΨ over the evaluation grid. It is
    a multiple of the squared parameter error if G = c² I.

    Raises
    ------
    SpecificationError
        If G is no multiple of the identity matrix, or the system changes with time.
    """
    q, points = len(true_parameters(system)), evaluation_set(system)
    at = system.points(points.states, points.inputs)[: points.n_grid]
    _, regressors = linear_terms(system, at)
    G = np.einsum("nri,nrj->ij", regressors, regressors) / len(at)
    square = float(G[0, 0])
    if len(system.history) > 1 or not np.allclose(
        G, square * np.eye(q), rtol=0.0, atol=TOLERANCE * abs(square)
    ):
        raise SpecificationError(
            f"the loss of env '{system.name}' weighs its parameters differently, but a parameter "
            f"error follows from a loss that weighs all alike: run the trials again with "
            f"dopt.run and compare their parameters."
        )
    return float(np.sqrt(square))


def measure(reader: Reader, found: Iterable[Entry]) -> pd.DataFrame:
    """Return one row for each finished trial: samples to the error, and the error at the end.

    ``samples`` is the number of inputs after which the parameter error stays at most
    :data:`ERROR`, inf where it does not or the trial diverged.
    """
    rows: list[dict[str, object]] = []
    for entry in found:
        curves = read_curves(reader, entry, "loss")
        errors = curves.values / loss_by_parameter_error(system_of(entry.config.config))
        samples = last_passage(errors, ERROR)
        facts = {
            "n_pendulums": _size(entry),
            "policy": entry.config.policy,
            "horizon": entry.config.horizon,
        }
        rows += [
            facts | {"seed": int(seed), "samples": float(count), "final_error": float(error)}
            for seed, count, error in zip(curves.seeds, samples, errors[:, -1], strict=True)
        ]
    return pd.DataFrame(rows)


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Return medians, exponents and ratios to random inputs with their intervals of 95 %.

    One row for each policy and number of pendulums. ``ratio`` is the geometric mean of
    the ratio of samples to random inputs of the same seed, ``exponent`` the exponent of the policy
    over all numbers.
    """
    rows = []
    for policy, own in trials.groupby("policy", sort=False):
        by_size = {
            int(str(size)): part.samples.to_numpy(float)
            for size, part in own.groupby("n_pendulums")
        }
        growth = exponent(by_size, np.random.default_rng(_SEED))
        for size, values in by_size.items():
            row: dict[str, object] = {"policy": policy, "n_pendulums": size, "n": len(values)}
            row["horizon"] = int(own[own.n_pendulums == size].horizon.iloc[0])
            row["reached"] = int(np.isfinite(values).sum())
            row |= interval_columns("median", median(values, np.random.default_rng(_SEED)))
            of_size = trials[trials.n_pendulums == size]
            question = f"coupled_pendulums/{size}"
            ratio = ratio_to_random(of_size, str(policy), "samples", question)
            row |= interval_columns("ratio", ratio)
            rows.append(row | interval_columns("exponent", growth))
    return pd.DataFrame(rows)


def tables(table: pd.DataFrame) -> tuple[TextTable, TextTable]:
    """Return the samples of all policies beside the published ones, and their ratios."""
    return samples_table(table), ratio_table(table)


def samples_table(table: pd.DataFrame) -> TextTable:
    """Return the medians of all policies beside the published rows, and the exponents."""
    sizes = sorted(set(table.n_pendulums))
    rows = [
        [policy, *(_cell(own, size, _median_text) for size in sizes), _exponent_text(own)]
        for policy, own in table.groupby("policy", sort=False)
    ]
    for policy, samples in FLEX_SAMPLES.items():
        printed = dict(zip(FLEX_SIZES, samples, strict=True))
        texts = [
            steps_text(printed[size], FLEX_LONGEST) if size in printed else "–" for size in sizes
        ]
        rows.append([f"published: {policy}", *texts, f"{published_exponent(policy):.2f}"])
    note = (
        f"Samples until the error of the frictions stays at most {ERROR:g} / s: median over the "
        f"trials [interval of 95 %]. Exponent a of samples ∝ N^a, from the medians."
    )
    return TextTable(["policy", *(f"N = {size}" for size in sizes), "a"], rows, note)


def ratio_table(table: pd.DataFrame) -> TextTable:
    """Return the ratio of samples to random inputs, beside the published ratios."""
    sizes = sorted(set(table.n_pendulums))
    rows = [
        [policy, *(_cell(own, size, ratio_text) for size in sizes)]
        for policy, own in table.groupby("policy", sort=False)
        if policy != REFERENCE
    ]
    pairs = zip(FLEX_SAMPLES["FLEX"], FLEX_SAMPLES["random"], strict=True)
    texts = [f"{a / b:.2f}" if b < np.inf else f"< {a / FLEX_LONGEST:.2f}" for a, b in pairs]
    printed = dict(zip(FLEX_SIZES, texts, strict=True))
    rows.append(["published: FLEX", *(printed.get(size, "–") for size in sizes)])
    note = "Ratio of samples to random inputs: paired geometric mean [interval of 95 %]."
    return TextTable(["policy", *(f"N = {size}" for size in sizes)], rows, note)


def published_exponent(policy: str) -> float:
    """Return the exponent of the published samples of a policy, over the numbers it reached."""
    kept = [
        (size, samples)
        for size, samples in zip(FLEX_SIZES, FLEX_SAMPLES[policy], strict=True)
        if np.isfinite(samples)
    ]
    sizes, reached = zip(*kept, strict=True)
    return float(slopes(sizes, np.array([reached]))[0])


def _cell(own: pd.DataFrame, size: int, text: Callable[[Mapping[Hashable, Any]], str]) -> str:
    rows = own[own.n_pendulums == size].to_dict("records")
    return text(rows[0]) if rows else "–"


def _median_text(row: Mapping[Hashable, Any]) -> str:
    names = ("median", "median_low", "median_high")
    texts = [steps_text(row[name], int(row["horizon"])) for name in names]
    return f"{texts[0]} [{texts[1]}, {texts[2]}]"


def _exponent_text(own: pd.DataFrame) -> str:
    first = own.iloc[0]
    return within(first.exponent, first.exponent_low, first.exponent_high)
