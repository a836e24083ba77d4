"""Numbers of trials: curves, learned models; frames for a notebook.

import analysis

results = analysis.load(env="pendulum")
results.trials()                       # one row for each trial
results.curves("loss")                 # one row for each trial and step
results.matrix("pendulum", "random")   # losses (seed, t)
results.reader.query("SELECT * FROM v_assessment")   # rows of any SELECT
results.model(trial).predict(states)   # learned accelerations (N, r) of a row of trials()
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.matching import AnalysisError, Filter, accepted, choose, latest_sources
from analysis.data.selection import Entry, environment_rank, policy_rank
from dopt.assessment import SAMPLE_LOSS, Plane
from dopt.evaluation import rates
from dopt.limits import LIMITS
from dopt.registry import build_optional
from dopt.spec.scaled import learned_accelerations
from dopt.spec.trial import TrialSpec, is_prequential, stored_trial
from dopt.systems import System
from dopt.types import Array, Integers
from orchestrate.store import CONFIG_COLUMNS, ConfigRow, Curves, Reader, default_url
from orchestrate.store.records import stacked
from orchestrate.store.schema import STEP_VALUES


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


def read_sample(reader: Reader, entry: Entry, column: str) -> Curves:
    """Return the curves (n, T) that a statistic sees: a diverged trial leaves its whole curve."""
    curves = read_curves(reader, entry, column)
    kept = ~curves.diverged
    return Curves(curves.seeds[kept], curves.t, curves.values[kept], curves.diverged[kept])


def bounded_states(config: Mapping[str, Any], system: System) -> dict[int, Array]:
    """Return the lower and the upper bound (2,) of each state that has one, by its place.

    Bounds are in the unit of the state, infinite where a side is unbounded.
    """
    limits = build_optional("limits", LIMITS, config.get("limits"))
    if limits is None:
        return {}
    bounds = limits.of_states(system)
    return {int(i): bounds[i] for i in np.flatnonzero(np.isfinite(bounds).any(axis=1))}


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
        SpecificationError
            If they are no numbers, or not of the shapes above.
        """
        values = learned_accelerations(self.spec, self.parameters, states, inputs)
        if inputs is not None:
            x, u = np.atleast_2d(np.asarray(states, float)), np.atleast_2d(inputs)
            accelerations = values
            values = rates(self.spec.system, lambda *_: accelerations, u, x)
        return values[0] if np.ndim(states) == 1 else values


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


def read_request(env: object, policy: object, where: object) -> Filter:
    """Return the filter of a request; raise AnalysisError for arguments of another kind."""
    return Filter(
        _names("env", env, "pendulum"),
        _names("policy", policy, "random"),
        {} if where is None else _conditions(where),
    )


def trial_key(trial: object) -> str:
    """Return the key of a trial that is given as its key or as a row of the table of trials."""
    if isinstance(trial, str):
        return trial
    if isinstance(trial, Mapping | pd.Series):
        key = trial.get("trial_key")
        if isinstance(key, str):
            return key
    given = f"a table of {len(trial)} rows" if isinstance(trial, pd.DataFrame) else _short(trial)
    raise AnalysisError(
        f"The trial is {given}, but one row of results.trials() or a trial key is expected: "
        f"give for instance results.trials().iloc[0]."
    )


def _names(what: str, given: object, example: str) -> tuple[str, ...]:
    if isinstance(given, str):
        return (given,)
    names = tuple(given) if isinstance(given, Iterable) else (given,)
    if all(isinstance(name, str) for name in names):
        return names
    raise AnalysisError(
        f"{what} is {_short(given)}, but a name or a list of names is expected: write for "
        f'instance {what}="{example}".'
    )


def _conditions(given: object) -> Mapping[str, object]:
    if isinstance(given, Mapping) and all(isinstance(path, str) for path in given):
        return given
    raise AnalysisError(
        f"where is {_short(given)}, but a mapping of dotted paths to values is expected: "
        f"write for instance where={{'model.width': 32}}."
    )


def _short(given: object) -> str:
    return " ".join(reprlib.repr(given).split())


@dataclass(frozen=True)
class Trajectories:
    """States and inputs of the finished trials of one configuration.

    Attributes
    ----------
    seeds : (n,)
    t : (T + 1,)
        Time of each state [s].
    states : (n, T + 1, d)
        NaN from a divergence on, and after the end of a shorter exploration.
    inputs : (n, T, m)
    """

    seeds: Integers
    t: Array
    states: Array
    inputs: Array


def load(
    db: str | None = None,
    env: str | Iterable[str] = (),
    policy: str | Iterable[str] = (),
    where: Mapping[str, object] | None = None,
) -> Results:
    """Open a results database for reading.

    Parameters
    ----------
    db
        URL; by default the variable ``DOPT_DB``, else ``sqlite:///results/results.db``.
    env, policy
        Names of environments and policies; none means all.
    where
        Values of the configuration by dotted path, such as ``{"model.width": 32}``.

    Raises
    ------
    NoDatabaseError, SchemaVersionError
        If there is nothing to read, or it was written by another version of the program.
    AnalysisError
        If ``env``, ``policy`` or ``where`` is of another kind. If a name is not stored or nothing
        fits, the methods of the results raise it.
    """
    url = db or default_url()
    wanted = read_request(env, policy, where)
    return Results(Reader.open(url), wanted)


class Results:
    """The configurations of a database that fit a request; a context manager that closes it.

    Every method reads the database again, and so sees what a running launch has finished.
    """

    def __init__(self, reader: Reader, wanted: Filter) -> None:
        self.reader = reader
        self._wanted = wanted

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def configurations(self) -> pd.DataFrame:
        """Return one row for each configuration, with the number of its trials by status."""
        table = pd.DataFrame([asdict(config) for config in self._configs()])
        return table.set_index("config_key")

    def shown(self) -> pd.DataFrame:
        """Return the configurations that figures show: one for each environment and policy.

        Rows as in :meth:`configurations`. Raises ``AnalysisError`` where two
        configurations fit equally well.
        """
        chosen = choose(self._configs())
        return self.configurations().loc[[config.config_key for config in chosen]]

    def trials(self) -> pd.DataFrame:
        """Return one row for each registered trial: configuration, status, losses, cost, node."""
        return pd.concat(
            [
                _labelled(pd.DataFrame(map(asdict, self.reader.trials(config.config_key))), config)
                for config in self._configs()
            ],
            ignore_index=True,
        )

    def curves(self, *columns: str) -> pd.DataFrame:
        """Return one row for each finished trial and step, by default with all columns of a step.

        ``t`` is the step and ``time`` the same in seconds; after a divergence values are NaN.
        """
        return pd.concat(
            [self._tidy(config, columns or STEP_VALUES) for config in self._configs()],
            ignore_index=True,
        )

    def _tidy(self, config: ConfigRow, columns: tuple[str, ...]) -> pd.DataFrame:
        with self.reader.moment() as moment:
            read = {name: moment.curves(config.config_key, name) for name in columns}
        first = next(iter(read.values()))
        n, steps = first.values.shape
        frame = pd.DataFrame({"seed": np.repeat(first.seeds, steps), "t": np.tile(first.t, n)})
        frame["time"] = config.dt * frame["t"]
        frame["diverged"] = np.repeat(first.diverged, steps)
        values = {name: column.values.ravel() for name, column in read.items()}
        return _labelled(frame.assign(**values), config)

    def matrix(self, env: str, policy: str, column: str = "loss") -> Curves:
        """Return one column of the steps of a policy in an environment as a matrix (seed, t).

        Where several configurations fit, the one that figures show is taken.
        """
        return self.reader.curves(self._one(env, policy).config_key, column)

    def trajectories(self, env: str, policy: str) -> Trajectories:
        """Return states and inputs of the finished trials of a policy in an environment."""
        config = self._one(env, policy)
        with self.reader.moment() as moment:
            trials = moment.trials(config.config_key)
            seeds = [trial.seed for trial in trials if trial.status in ("done", "diverged")]
            paths = [moment.trajectory(config.config_key, seed) for seed in seeds]
        if not seeds:
            raise AnalysisError(f"{env} × {policy} has no finished trial: run the grid first.")
        return Trajectories(
            seeds=np.array(seeds, dtype=np.int64),
            t=config.dt * np.arange(max(len(path.states) for path in paths), dtype=np.float64),
            states=stacked([path.states for path in paths]),
            inputs=stacked([path.inputs for path in paths]),
        )

    def model(self, trial: str | Mapping[str, object] | pd.Series[Any]) -> LearnedModel:
        """Return the model that a finished trial learned, with ``predict(states, inputs=None)``.

        Parameters
        ----------
        trial
            A row of :meth:`trials`, such as ``results.trials().iloc[0]``, or a trial key.

        Raises
        ------
        AnalysisError
            If it is neither a row nor a key, or no trial of the request has that key.
        QueryError
            If the trial is not finished.
        """
        key = trial_key(trial)
        for config in self._configs():
            for row in self.reader.trials(config.config_key):
                if row.trial_key == key:
                    return learned_model(self.reader, config, row.seed)
        raise AnalysisError(
            f"No trial of the request has the key '{key}': take one of results.trials()."
        )

    def _one(self, env: str, policy: str) -> ConfigRow:
        chosen = choose(config for config in self._configs() if config.env == env)
        found = [config for config in chosen if config.policy == policy]
        if not found:
            have = ", ".join(sorted({f"{c.env} × {c.policy}" for c in self._configs()}))
            raise AnalysisError(
                f"No configuration of {env} × {policy} fits the request, stored are {have}: "
                f"choose one of these."
            )
        return found[0]

    def _configs(self) -> list[ConfigRow]:
        fitting = latest_sources(self.reader, accepted(self.reader, self._wanted))
        return sorted(fitting, key=lambda c: (environment_rank(c.env), policy_rank(c.policy)))


def _labelled(frame: pd.DataFrame, config: ConfigRow) -> pd.DataFrame:
    """Put what tells the configuration in front."""
    for place, name in enumerate(CONFIG_COLUMNS):
        frame.insert(place, name, getattr(config, name))
    frame.insert(len(CONFIG_COLUMNS), "config_key", config.config_key)
    return frame
