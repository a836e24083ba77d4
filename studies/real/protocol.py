"""Fits to some recorded runs, judged on a run that was left out, beside published constants.

A window of a left-out run has a history, to which the initial state alone is fitted, and what comes
after it, which is simulated with the recorded inputs. The published model is simulated in the same
windows, from initial states that are fitted in the same way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from dopt.fitting.fit import fit
from dopt.fitting.fitted import Fitted
from dopt.fitting.model import Model, data_of
from dopt.fitting.problem import Simulator, predicted
from dopt.fitting.simulation import Data
from dopt.log import Log
from dopt.systems.base import next_state
from dopt.systems.plant import Plant
from studies.real.plants import Controller

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SKIPPED = 0.05
"""First part of a run in which no window begins, so that the inputs that act are known [s]."""

AROUND = 0.5
"""An angle moves by what it does so long before and after a row [s]."""

LOOP = 10.0
"""Time for which a closed loop is simulated [s]."""

STRETCH = 2.0
"""Windows that begin within so many seconds are drawn together [s]."""


@dataclass(frozen=True)
class Case:
    """A plant, what a fit to it is given, and what it is asked.

    Attributes
    ----------
    plant : Plant
    columns : mapping of str to str
        Columns of the states and inputs.
    reference : Plant, optional
        Published one; without it, the constants alone of the same fit.
    history : float
        Length of a history [s].
    horizons : tuple of float
        Times after the history at which errors are taken [s]; none for all rows of one window that
        is as long as the run.
    every : float
        Time from one window to the next [s].
    moved : float
        Smallest range of an angle after the history, in windows and in training data [rad].
    options : mapping of str to object
        Of :func:`dopt.fit`.
    controller : Controller, optional
        What balanced the plant, of whose angles the closed loop is simulated as well.
    """

    plant: Plant
    columns: Mapping[str, str]
    history: float
    reference: Plant | None = None
    horizons: tuple[float, ...] = ()
    every: float = 0.1
    moved: float = 0.0
    options: Mapping[str, Any] = field(default_factory=dict)
    controller: Controller | None = None


class Fold(NamedTuple):
    """Errors on a run that was left out.

    Attributes
    ----------
    run : str
    ours, theirs : (k, h, n)
        Errors of k windows, at h times, of n measured states; inf where a simulation diverged.
    stretches : (k,)
        Number of the stretch in which a window begins.
    found : str
        What was fitted.
    closed : (2, n) or None
        Errors of the closed loop, ours and of the reference, root mean square [rad].
    """

    run: str
    ours: Array
    theirs: Array
    stretches: Integers
    found: str
    closed: Array | None = None


def folds(
    case: Case,
    parts: Mapping[str, pd.DataFrame],
    test: pd.DataFrame | None,
    workers: int,
    say: Callable[[str], None],
) -> list[Fold]:
    """Return the errors on each part, with a fit to the others; or on a test, with one to all."""

    def log_of(table: pd.DataFrame) -> Log:
        return Log.for_plant(table, case.plant, case.columns)

    given = {name: log_of(moving(part, case)) for name, part in parts.items()}
    tests = {name: log_of(part) for name, part in (parts if test is None else {"": test}).items()}

    def one(name: str) -> Fold:
        others = [log for other, log in given.items() if other != name]
        found = judged(case, name, others, tests[name], inner)
        say(f"{name}: {found.found}")
        if found.closed is not None:
            ours, theirs = (np.array2string(one, precision=3) for one in found.closed)
            say(f"{name}: closed loop over {LOOP:g} s, RMSE {ours} rad, reference {theirs} rad")
        return found

    inner = max(1, workers // len(tests))
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, tests))


def judged(case: Case, name: str, given: Sequence[Log], left_out: Log, workers: int) -> Fold:
    """Fit a plant to logs, and return the errors on another one, also of the reference."""
    fitted = fit(case.plant, given, workers=workers, **case.options)
    own, alone = fitted.chosen, fitted.physics
    data = data_of(fitted.plant, [left_out], fitted.hold, fitted.data.deviations)
    rows = windows(case, data)
    ours = _errors(case, Simulator(own.model, data), own.solution.p, rows)
    if case.reference is None:
        theirs = _errors(case, Simulator(alone.model, data), alone.solution.p, rows)
    else:
        published = Model(case.reference)
        theirs = _errors(case, Simulator(published, data), published.prior, rows)
    closed = None
    if case.controller is not None and case.reference is not None:
        values = {
            name: value
            for name, (value, _) in fitted.constants.items()
            if name in case.plant.constants
        }
        mine = dataclasses.replace(case.plant, constants=values)
        pair = (closed_loop(one, case.controller, data) for one in (mine, case.reference))
        closed = np.array([*pair])
    return Fold(name, ours, theirs, _stretches(case, data, rows), _described(fitted), closed)


def closed_loop(plant: Plant, controller: Controller, data: Data) -> Array:
    """Return the errors of the angles, (n,), root mean square, of the plant under its controller.

    The simulation begins at the first recorded angles, at rest. The test signal is what the
    recorded inputs have beyond what the controller asked for at the recorded angles.
    """
    rows = int(LOOP / plant.dt)
    system, angles = plant.system(rows), data.measured[:rows]
    n, parameters = angles.shape[1], system.parameters
    recorded, own, errors = np.zeros((2, n)), np.zeros((2, n)), np.empty_like(angles)
    x, signal = np.concatenate([angles[0], np.zeros(system.n_states - n)]), 0.0
    for t, measured in enumerate(angles):
        errors[t] = x[:n] - measured
        recorded, asked = controller.step(recorded, measured, plant.dt)
        applied = float(data.inputs[t, 0])
        if abs(applied) < controller.limit:
            signal = applied - asked
        own, asked = controller.step(own, x[:n], plant.dt)
        u = np.clip([asked + signal], -controller.limit, controller.limit)
        rate = lambda z, u=u: np.array(system.known(tuple(z), tuple(u), parameters))  # noqa: E731  # of this input
        x = next_state("rk4", rate, x, plant.dt)
    found: Array = np.sqrt(np.mean(errors**2, axis=0))
    return found


def _described(fitted: Fitted) -> str:
    constants = ", ".join(f"{name} {value:.4g}" for name, (value, _) in fitted.constants.items())
    network = "with" if fitted.has_network else "without"
    return f"windows of {fitted.selection.window:.3g} s, {network} a network, {constants}"


def _errors(case: Case, simulator: Simulator, p: Array, rows: Integers) -> Array:
    found = predicted(simulator, p, rows)
    if not case.horizons:
        return found.errors[0][:, None, :]
    return np.stack([found.at(horizon)[0] for horizon in case.horizons], axis=1)


def _stretches(case: Case, data: Data, rows: Integers) -> Integers:
    times = data.time[rows[:, 1]]
    if not case.horizons:
        times = data.time[rows[0, 1] + 1 : rows[0, 2] + 1]
    return (times / STRETCH).astype(np.int64)


def windows(case: Case, data: Data) -> Integers:
    """Return first row, last row of the history and last row of each window, (k, 3)."""
    time, last = data.time - data.time[0], len(data.time) - 1
    seen = np.flatnonzero(np.isfinite(data.measured).all(axis=1))

    def row(seconds: float) -> int:
        return int(seen[min(int(np.searchsorted(time[seen], seconds - 1e-9)), len(seen) - 1)])

    if not case.horizons:
        return np.array([[row(SKIPPED), row(case.history), last]], np.int64)
    out, ahead = [], max(case.horizons)
    for start in np.arange(SKIPPED, time[last] - case.history - ahead, case.every):
        first = row(start)
        middle = row(time[first] + case.history)
        end = row(time[middle] + ahead)
        if time[end] >= time[middle] + ahead - 1e-9 and _moves(data, middle, end, case.moved):
            out.append((first, middle, end))
    return np.array(out, np.int64).reshape(-1, 3)


def _moves(data: Data, first: int, last: int, least: float) -> bool:
    inside = data.measured[first : last + 1]
    return bool((np.nanmax(inside, axis=0) - np.nanmin(inside, axis=0)).max() >= least)


def moving(table: pd.DataFrame, case: Case) -> pd.DataFrame:
    """Return a run without inputs in the rows around which no angle moves: pieces end there."""
    if not case.moved:
        return table
    time = np.maximum.accumulate(table["time"].to_numpy())
    angles = table[[case.columns[name] for name in case.plant.measured]].to_numpy()
    ends = np.searchsorted(time, [time - AROUND, time + AROUND])
    ranges = [np.ptp(angles[first:last], axis=0).max() for first, last in ends.T]
    inputs = [case.columns[name] for name in case.plant.inputs]
    kept = table.copy()
    kept.loc[np.array(ranges) < case.moved, inputs] = np.nan
    return kept
