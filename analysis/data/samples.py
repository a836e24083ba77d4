"""Numbers of selected trials: curves, rules for diverged ones, bounded states, learned models."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.data.selection import Entry
from analysis.errors import AnalysisError
from analysis.style import of_finished
from dopt.assessment import SAMPLE_LOSS, Plane
from dopt.limits import VIOLATIONS, limits_from
from dopt.spec.scaled import learned_accelerations
from dopt.spec.trial import TrialSpec, is_prequential, stored_trial
from dopt.systems import System
from orchestrate.store import ConfigRow, Curves, Reader

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


class DivergenceRule(StrEnum):
    """How diverged trials enter a statistic.

    ``EXCLUDE`` leaves them out, from the first step to the last; ``WORST`` and ``MEDIAN`` give them
    at each step the largest and the median loss of the trials that did not diverge.
    """

    EXCLUDE = "exclude"
    WORST = "worst"
    MEDIAN = "median"


@dataclass(frozen=True)
class Sample:
    """Curves that enter a statistic.

    Attributes
    ----------
    seeds : (n,)
    values : (n, T)
        Finite, after the rule was applied.
    n_finished : int
        Trials that ran to an end, diverged ones included.
    n_diverged : int
    """

    seeds: npt.NDArray[np.int64]
    values: Array
    n_finished: int
    n_diverged: int

    def describe(self) -> str:
        """Return the count to print, such as ``98/100, 2 diverged``."""
        return of_finished(len(self.values), self.n_finished, self.n_diverged)


def apply_rule(
    seeds: npt.NDArray[np.int64], values: Array, diverged: Mask, rule: DivergenceRule
) -> Sample:
    """Return the sample (n, T) that a statistic sees, of trials (N, T) with NaN past divergence.

    Without a trial that survived, ``WORST`` and ``MEDIAN`` have nothing to lend and the sample is
    empty.
    """
    kept = values[~diverged]
    if rule is DivergenceRule.EXCLUDE or not len(kept) or not diverged.any():
        return Sample(seeds[~diverged], kept, len(values), int(diverged.sum()))
    lent = np.max(kept, axis=0) if rule is DivergenceRule.WORST else np.median(kept, axis=0)
    filled = np.where(diverged[:, None], lent, values)
    return Sample(seeds, filled, len(values), int(diverged.sum()))


def read_curves(reader: Reader, entry: Entry, column: str) -> Curves:
    """Return one column of the entry's finished trials.

    A launch may be writing: trials that ended after the selection was made are left out. Curves of
    explorations are cut at the end of the shortest, so that all of them are compared at each step.
    """
    curves = reader.curves(entry.config.config_key, column)
    kept = np.isin(curves.seeds, [trial.seed for trial in entry.finished])
    lengths = [trial.n_steps or 0 for trial in entry.finished if trial.status == "done"]
    n = min(lengths, default=len(curves.t))
    return Curves(curves.seeds[kept], curves.t[:n], curves.values[kept, :n], curves.diverged[kept])


def read_sample(reader: Reader, entry: Entry, column: str, rule: DivergenceRule) -> Sample:
    """Return the curves (n, T) that a statistic sees."""
    curves = read_curves(reader, entry, column)
    return apply_rule(curves.seeds, curves.values, curves.diverged, rule)


def bounded_states(config: Mapping[str, Any], system: System) -> dict[int, Array]:
    """Return the lower and the upper bound (2,) of each state that has one, by its place.

    Bounds are in the unit of the state, infinite where a side is unbounded.
    """
    limits = limits_from(config.get("limits"))
    if limits is None:
        return {}
    bounds = limits.of_states(system)
    return {int(i): bounds[i] for i in np.flatnonzero(np.isfinite(bounds).any(axis=1))}


def violation_shares(reader: Reader, entry: Entry) -> dict[int, float]:
    """Return the share of steps after which a bound is exceeded, by the seed of a finished trial.

    Steps before a trial diverged count. Trials without limits have none.
    """
    found = reader.assessments(entry.config.config_key, VIOLATIONS)
    values = found.values / np.maximum(found.t, 1)
    counted = {
        int(seed): row[np.isfinite(row)] for seed, row in zip(found.seeds, values, strict=True)
    }
    finished = [trial.seed for trial in entry.finished]
    return {seed: float(counted[seed].sum()) for seed in finished if len(counted.get(seed, ())) > 0}


def sample_losses(reader: Reader, entry: Entry) -> dict[int, float]:
    """Return the stored sample losses of the trials that are done, by seed."""
    found = reader.assessments(entry.config.config_key, SAMPLE_LOSS)
    stored = dict(zip(found.seeds.tolist(), found.values[:, -1:].ravel().tolist(), strict=True))
    return {
        seed: stored[seed] for seed in entry.final_losses() if np.isfinite(stored.get(seed, np.nan))
    }


def coverages(reader: Reader, entry: Entry, plane: Plane) -> dict[int, float]:
    """Return the share of the plane's cells that each trial visits, by seed; without diverged."""
    key = entry.config.config_key
    seeds = entry.final_losses()
    return {seed: plane.coverage(reader.trajectory(key, seed).states) for seed in seeds}


@dataclass(frozen=True)
class LearnedModel:
    """The model of a trial with the parameters that it had learned at the end.

    Attributes
    ----------
    spec : TrialSpec
        The trial; ``spec.system`` has the true accelerations, ``spec.system.learned(states)``.
    parameters : (q,)
        Parameters of the model, as stored.
    """

    spec: TrialSpec
    parameters: Array

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike | None = None) -> Array:
        """Return the learned accelerations, or with inputs the whole derivative of the state.

        Parameters
        ----------
        states : (N, d) or (d,)
            States in the units of ``spec.system.state_labels``.
        inputs : (N, m) or (m,), optional
            Inputs in the units of ``spec.system.input_labels``.

        Returns
        -------
        (N, r) or (r,)
            Accelerations at zero input, one for each learned row of the state, per second what that
            state is measured in. With inputs dx/dt = known(x, u) + E a(x), (N, d) or (d,).

        Raises
        ------
        AnalysisError
            If they are no numbers, or not of the shapes above.
        """
        x = _rows(states, self.spec.system.n_states, "states")
        single = np.ndim(states) == 1
        u = None if inputs is None else _rows(inputs, self.spec.system.n_inputs, "inputs")
        if u is not None and len(u) not in (1, len(x)):
            raise AnalysisError(
                f"inputs have {len(u)} rows and states have {len(x)}, but as many are expected: "
                f"give one input for each state."
            )
        values = learned_accelerations(self.spec, self.parameters, x, u)
        if u is not None:
            values = self._derivative(x, u, values)
        return values[0] if single else values

    def _derivative(self, x: Array, u: Array, accelerations: Array) -> Array:
        system = self.spec.system
        known = system.known(tuple(x.T), tuple(u.T), system.parameters)
        flow = np.stack([np.broadcast_to(row, len(x)) for row in known], axis=-1).astype(float)
        flow[:, list(system.learned_rows)] += accelerations
        return flow


def _rows(given: npt.ArrayLike, size: int, what: str) -> Array:
    try:
        rows = np.atleast_2d(np.asarray(given, dtype=float))
    except (TypeError, ValueError) as error:
        raise AnalysisError(
            f"{what} are {reprlib.repr(given)}, but numbers of the shape (N, {size}) or ({size},) "
            f"are expected: give one row for each point."
        ) from error
    if rows.ndim != 2 or rows.shape[1] != size:
        raise AnalysisError(
            f"{what} have the shape {np.shape(given)}, but (N, {size}) or ({size},) is expected: "
            f"give one row for each point."
        )
    return rows


def learned_model(reader: Reader, configuration: ConfigRow, seed: int) -> LearnedModel:
    """Read the final parameters of a trial; raise ``QueryError`` where it is not finished."""
    spec = stored_trial(configuration.config, seed)
    parameters = reader.trajectory(configuration.config_key, seed).parameters
    return LearnedModel(spec, parameters)


def simulated_trial(configuration: ConfigRow, seed: int) -> TrialSpec:
    """Return the specification of a trial, to run it or its system again.

    Raises
    ------
    AnalysisError
        If it is an exploration, which nothing can simulate.
    """
    if is_prequential(configuration.config):
        raise AnalysisError(
            f"{configuration.env} × {configuration.policy} is an exploration that was measured, "
            f"but a trial that can be simulated again is needed here: choose another one."
        )
    return stored_trial(configuration.config, seed)
