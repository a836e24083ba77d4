"""Error of predictions of a recorded run, of which all states are known or some are measured."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from dopt.control.free_run import relative_error
from dopt.control.prediction import forecast_by
from dopt.errors import SpecificationError
from dopt.explorer.arguments import reals, whole
from dopt.explorer.output_filter import filtered_states
from dopt.learning import JointKalman
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array


def free_run_error(
    spec: TrialSpec,
    predict: Callable[[Array, Array], Array],
    states: npt.ArrayLike,
    inputs: npt.ArrayLike,
    steps: int = 50,
) -> float:
    """Return the error of :meth:`Explored.free_run_error` of what predicts accelerations.

    Where the run has the measured states alone, predictions start from the estimates of a filter,
    the first of them after so many steps as a prediction has, and their error is that of the
    measured states.
    """
    system = spec.system
    y, u = (np.atleast_1d(reals(*run)) for run in (("states", states), ("inputs", inputs)))
    steps = whole("steps", steps)
    rows = _rows_of(system, y)
    first = 0 if isinstance(rows, slice) else max(steps, 1)  # in which the filter settles
    n = (len(u) - first) // max(steps, 1)
    _check_shapes(system, y, u, steps, n)
    _check_finite(y, u)
    for column, row in enumerate(np.arange(system.n_states)[rows]):
        if row in system.angle_indices:
            y[:, column] = np.unwrap(y[:, column])
    x = y if isinstance(rows, slice) else filtered_states(system, predict, y, u, _variance(spec))
    last = first + n * steps
    cut = u[first:last].reshape(n, steps, system.n_inputs)
    starts, ends = y[first:last:steps], y[first + 1 : last + 1].reshape(n, steps, -1).swapaxes(0, 1)
    if (starts == ends).all():
        raise SpecificationError(
            "a run was given in which nothing changes, but the error of its predictions is "
            "relative to the changes: give a run that moves."
        )
    predicted = forecast_by(system, predict)(x[first:last:steps], cut)
    return relative_error(predicted[..., rows], ends, starts)


def _rows_of(system: System, run: Array) -> slice | list[int]:
    """Return the states that a run has: all of them, or those that are measured."""
    given, measured = run.shape[-1] if run.ndim == 2 else 0, list(system.measured_states)
    return measured if given == len(measured) < system.n_states else slice(None)


def _check_shapes(system: System, run: Array, inputs: Array, steps: int, n: int) -> None:
    d, m, measured = system.n_states, system.n_inputs, system.n_measured
    fits = run.ndim == 2 and len(run) == len(inputs) + 1 and run.shape[1] in (d, measured or d)
    if not fits or inputs.shape != (len(inputs), m) or steps < 1 or n < 1:
        alone = f", or (T + 1, {measured}) and twice as many," if 0 < measured < d else ""
        raise SpecificationError(
            f"a run with states of shape {run.shape} and inputs of shape {inputs.shape} was given "
            f"for predictions of {steps} steps, but shapes (T + 1, {d}) and (T, {m}) with at least "
            f"so many steps T{alone} are expected: correct it."
        )


def _check_finite(run: Array, inputs: Array) -> None:
    for what, rows in (("states", run), ("inputs", inputs)):
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            raise SpecificationError(
                f"a run was given in which the {what} of row {bad[0]} are {rows[bad[0]].tolist()}, "
                f"but finite numbers are expected: give a part of the run without such rows."
            )


def _variance(spec: TrialSpec) -> float:
    """Return ρ of the filter over the state: that of the learner, or of joint_ekf by default."""
    learner = spec.learner if isinstance(spec.learner, JointKalman) else JointKalman()
    return learner.noise_variance
