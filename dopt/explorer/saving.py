"""Saves to a results database: the one part of dopt that uses orchestrate."""

from __future__ import annotations

import functools
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dopt.arguments import check_finite, reals, whole
from dopt.assessment import violations
from dopt.control.planning import Forecast, forecast_by, relative_error
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.signs import SIGNS, STORED
from dopt.explorer.state import ExplorerState, InFlight
from dopt.learning import JointKalman
from dopt.log import Log
from dopt.result import Assessment, TrialResult
from dopt.spec.scaled import learned_accelerations, scaled
from dopt.spec.trial import PrequentialTrial, TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import start_variances
from dopt.systems.plant import ExploredPlant, first_guess
from dopt.types import Array

if TYPE_CHECKING:
    from orchestrate.runner.saving import ExplorationSaver


# States of a recorded run of which some states are measured with noise, by a Kalman filter.


DIFFERENCE = 1e-5
"""Change of a state, relative to its size and 1, over which derivatives are taken."""


def filtered_states(
    system: System,
    predict: Callable[[Array, Array], Array],
    outputs: Array,
    inputs: Array,
    noise_variance: float,
) -> Array:
    """Return estimates of the states, (T + 1, d), each from what was measured until then.

    Parameters
    ----------
    predict : callable
        Accelerations, (N, r), of states (N, d) under inputs (N, m).
    outputs, inputs : (T + 1, n), (T, m)
        Measured states, and the inputs between them. The other states are taken for 0 at first, up
        to the half-width of the box, or 1.
    noise_variance : float
        ρ, the variance of the accelerations that the model leaves out.
    """
    forecast, measured = forecast_by(system, predict), list(system.measured_states)
    states, P = np.zeros((len(outputs), system.n_states)), np.diag(start_variances(system))
    states[0, measured] = outputs[0]
    Q, R = np.zeros_like(P), np.diag(np.square(system.measurement_noise))
    Q[system.learned_rows, system.learned_rows] = system.dt**2 * noise_variance
    for t, u in enumerate(inputs):
        x, A = _step(forecast, states[t], u)
        P = A @ P @ A.T + Q
        S = P[np.ix_(measured, measured)] + R
        gain = np.linalg.solve(S, P[measured]).T
        states[t + 1] = x + gain @ (outputs[t + 1] - x[measured])
        P = P - gain @ P[measured]
        P = 0.5 * (P + P.T)
    return states


def _step(forecast: Forecast, x: Array, u: Array) -> tuple[Array, Array]:
    """Return the state that follows, (d,), and its derivative A by the state, (d, d)."""
    d = len(x)
    steps = np.diag(DIFFERENCE * np.maximum(1.0, np.abs(x)))
    at = np.concatenate([x[None], x + steps, x - steps])
    following = forecast(at, np.broadcast_to(u, (len(at), 1, len(u))))[0]
    ahead, behind = following[1 : d + 1], following[d + 1 :]
    return following[0], ((ahead - behind) / (2.0 * np.diag(steps))[:, None]).T


# Error of predictions of a recorded run, of which all states are known or some are measured.


def free_run_error(
    spec: TrialSpec,
    predict: Callable[[Array, Array], Array],
    states: npt.ArrayLike,
    inputs: npt.ArrayLike,
    steps: int = 50,
    system: System | None = None,
) -> float:
    """Return the error of :meth:`Explored.free_run_error` of what predicts accelerations, (N, r).

    All numbers are in the units of the plant, which ``system`` describes if it is another one than
    in the specification, as after a refit.

    Where the run has the measured states alone, predictions start from the estimates of a filter,
    the first of them after so many steps as a prediction has, and the error is taken over the
    measured states.
    """
    system = spec.system if system is None else system
    y, u = np.atleast_1d(reals("states", states)), np.atleast_1d(reals("inputs", inputs))
    steps = whole("steps", steps)
    d, m, measured = system.n_states, system.n_inputs, list(system.measured_states)
    filtered = y.ndim == 2 and y.shape[1] == len(measured) < d
    rows = measured if filtered else slice(None)
    first = max(steps, 1) if filtered else 0  # in which the filter settles
    n = (len(u) - first) // max(steps, 1)
    width = len(measured) if filtered else d
    if y.shape != (len(u) + 1, width) or u.shape != (len(u), m) or steps < 1 or n < 1:
        raise SpecificationError(
            f"a run with states of shape {y.shape} and inputs of shape {u.shape} was given for "
            f"predictions of {steps} steps, but shapes (T + 1, {d}) and (T, {m}) with at least so "
            f"many steps T, or of measured states alone twice as many, are expected: correct it."
        )
    check_finite("states", y)
    check_finite("inputs", u)
    u = InFlight(system).acted(u)
    for column, row in enumerate(np.arange(system.n_states)[rows]):
        if row in system.angle_indices:
            y[:, column] = np.unwrap(y[:, column])
    x = y
    if filtered:
        found, learner = scaled(system), spec.learner
        learner = learner if isinstance(learner, JointKalman) else JointKalman()
        run = found.of_states(y, rows), found.of_inputs(u)
        by_model = found.scaled_predictions(predict)
        x = found.states * filtered_states(found.system, by_model, *run, learner.noise_variance)
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


# States, inputs, errors and predictions of an exploration so far.


KINDS = (
    "learned",
    "repeated",
    "out_of_order",
    "gaps",
    "unusable",
    "jumps",
    "resets",
    "missed",
    "refits",
    *SIGNS,
)
"""Kinds of events in :attr:`Explored.counts`."""


Run = tuple[npt.ArrayLike, npt.ArrayLike]
"""States, (T + 1, d), and inputs, (T, m)."""


class Explored:
    """States, inputs, errors and predictions of an exploration, which can be saved meanwhile.

    Whatever changes it holds ``_lock``, so that another thread can save it.

    Attributes
    ----------
    spec : TrialSpec
        Plant, policy, model, learner and seed.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self.spec, self._state = spec, ExplorerState(spec)
        self._lock, self._closed = threading.Lock(), False
        self._saving = threading.Lock()
        self._savers: dict[str | None, ExplorationSaver] = {}
        weakref.finalize(self, _close, self._savers)
        self._begun = time.perf_counter(), time.process_time()
        self._times = np.full((2, spec.system.horizon), np.nan)  # µs of ask() and tell()

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of events of each kind since the first step of the journal."""
        return {kind: self._state.counts[kind] for kind in KINDS}

    @property
    def n_steps(self) -> int:
        """Steps t that were learned from."""
        return self._state.done

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,); of a plant, of the model in scaled numbers.

        They do not depend on the units of the plant (:mod:`dopt.spec.scaled`).
        """
        return self._state.steps.parameters

    @property
    def constants(self) -> dict[str, float]:
        """Constants of a plant, ``delay``, ``lag`` [s]: guesses, or a refit's, without errors."""
        system = self._state.system
        if not isinstance(system, ExploredPlant):
            return {}
        plant = system.plant
        guesses = *plant.guesses.values(), first_guess(plant.delay), first_guess(plant.lag)
        names = *plant.constants, "delay", "lag"
        return dict(zip(names, system.fitted or guesses, strict=True))

    def log(self) -> Log:
        """Return what was measured and applied so far, for :func:`dopt.fit`.

        Raises
        ------
        SpecificationError
            If nothing was learned yet, or a system is explored that is no :class:`dopt.Plant`.
        """
        system = self._state.system
        if not isinstance(system, ExploredPlant):
            raise SpecificationError(
                f"env '{system.name}' is explored, but a dopt.Plant is expected for a log: its "
                f"states and inputs have names."
            )
        return self._state.run.log(system.plant)

    @property
    def states(self) -> Array:
        """States x_0 ... x_t from which steps were taken, and the last one, (t + 1, d).

        Where states are measured with noise they are estimates.

        Where the exploration went on from another state, as after a gap, that one is here.
        """
        return self._state.states[: self.n_steps + 1].copy()

    @property
    def inputs(self) -> Array:
        """Inputs that acted in each step, (t, m): as applied, or late where the plant says so."""
        return self._state.inputs[: self.n_steps].copy()

    @property
    def errors(self) -> Array:
        """Errors ‖y - a_θ(x, u)‖ of the accelerations, each before it was learned, (t,).

        Where states are measured with noise, they are errors of predicted measurements, in
        standard deviations of the noise.
        """
        return self._state.errors[: self.n_steps].copy()

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike | None = None) -> Array:
        """Return the learned accelerations, (N, r), at states, (N, d), and inputs, (N, m).

        Inputs count in a model that reads them, such as 'affine'; without any they are 0.
        """
        return learned_accelerations(self.spec, self.parameters, states, inputs)

    def free_run_error(
        self, states: npt.ArrayLike, inputs: npt.ArrayLike, steps: int = 50
    ) -> float:
        """Return the error of predictions of a recorded run from its start, without measurements.

        Parameters
        ----------
        states, inputs : (T + 1, d), (T, m)
            States that were measured dt apart, and the inputs between them; best of another run
            than the one that was learned from. Of a plant some of whose states are measured it may
            be these alone, (T + 1, n).
        steps : int
            Steps of a prediction; the run is cut into as many of them as it holds. Where states are
            measured the first piece has no prediction: the states are estimated in it.

        Returns
        -------
        float
            Relative root mean square error, without a unit: 0 for perfect predictions, 1 for the
            prediction that nothing changes (:func:`dopt.control.planning.relative_error`). Over
            measured states it includes their noise.

        Raises
        ------
        SpecificationError
            If the shapes do not fit, or the run has fewer steps.
        """
        return free_run_error(self.spec, self.predict, states, inputs, steps, self._state.system)

    def save(self, url: str | None = None, test: Run | None = None) -> bool:
        """Store the exploration so far as a trial in the results database of the launches.

        The loss of its steps is :attr:`errors`: prequential, not over a grid. Called again,
        also after the journal was reopened, it adds the new steps to the same trial in one
        transaction. It may be called from another thread than :meth:`ask` and :meth:`tell`.

        Parameters
        ----------
        url : str, optional
            Database, such as ``sqlite:///results.db``; by default the one a launch uses.
        test : (states, inputs), optional
            Another recorded run, of shapes (T + 1, d) and (T, m). The error of predictions of it
            (:meth:`free_run_error`) is stored as the assessment ``free_run_error``.

        Returns
        -------
        bool
            Whether something was written: not before the first step is learned, nor where more
            steps of this exploration are stored already.

        Raises
        ------
        StoreError
            If nothing was written, because the database fails, or because it holds another
            exploration of the same arguments. What was stored stays, and the exploration can go on.
        ExplorationError
            If the package orchestrate is not installed.
        SpecificationError
            If the test run has other shapes.
        """
        with self._saving:
            if url not in self._savers:
                self._savers[url] = new_saver(url)
            try:
                result = self._result(test)
                trial = PrequentialTrial(self.spec)
                return bool(len(result.loss)) and self._savers[url].save(trial, result)
            finally:
                if self._closed:
                    _close(self._savers)

    def _result(self, test: Run | None) -> TrialResult:
        with self._lock:
            states, inputs, errors = self.states, self.inputs, self.errors
            parameters, excess = self.parameters.copy(), self._state.excess[: self.n_steps].copy()
            counts, (asked, told) = self.counts, self._times[:, : self.n_steps].copy()
        at = _diverged_at(errors, parameters)
        n = len(errors) if at is None else at
        errors[n:] = np.nan
        unknown = np.full(len(errors), np.nan)
        tested: tuple[Assessment, ...] = ()
        if test is not None:
            tested += (self._tested(test, n, parameters),)
        if self.spec.limits is not None:
            tested += violations(excess[:n])
        tested += tuple(Assessment(n, sign, float(counts[sign])) for sign in STORED if counts[sign])
        return TrialResult(
            loss=errors,
            reachable_loss=unknown,
            plan_us=asked,
            learn_us=told,
            evaluate_us=unknown,
            states=states,
            inputs=inputs,
            parameters=parameters,
            diverged_at=at,
            wall_seconds=time.perf_counter() - self._begun[0],
            cpu_seconds=time.process_time() - self._begun[1],
            assessments=tested,
        )

    @contextmanager
    def _timed(self, row: int) -> Iterator[None]:
        """Note how long a call of :meth:`ask`, or of :meth:`tell`, takes; the longest of a step."""
        t, began = self.n_steps, time.perf_counter()
        yield
        if t < self._times.shape[1]:
            taken = 1e6 * (time.perf_counter() - began)
            self._times[row, t] = np.fmax(self._times[row, t], taken)  # the first one is NaN

    def _tested(self, test: object, n: int, parameters: Array) -> Assessment:
        if not isinstance(test, tuple | list) or len(test) != 2:
            raise SpecificationError(
                f"test is {type(test).__name__}, but a pair (states, inputs) is expected: give "
                f"both of a recorded run."
            )
        predicted = functools.partial(learned_accelerations, self.spec, parameters)
        states, inputs = test
        system = self._state.system
        error = free_run_error(self.spec, predicted, states, inputs, system=system)
        return Assessment(n, "free_run_error", error)

    def _close_savers(self) -> None:
        """End the launches of the saves."""
        with self._saving:
            _close(self._savers)


def _close(savers: dict[str | None, ExplorationSaver]) -> None:
    while savers:
        savers.popitem()[1].close()


def new_saver(url: str | None) -> ExplorationSaver:
    """Return what writes to a database; raise ExplorationError without orchestrate."""
    try:
        from orchestrate.runner.saving import ExplorationSaver
    except ModuleNotFoundError as error:
        raise ExplorationError(
            f"results are saved by the package orchestrate, but {error.name} is not "
            f"installed: install dopt with its dependencies."
        ) from error
    return ExplorationSaver(url)


def _diverged_at(errors: Array, parameters: Array) -> int | None:
    """Return the first step whose error, or the parameters after it, are not finite."""
    if not np.isfinite(errors).all():
        return int(np.argmin(np.isfinite(errors)))
    return None if np.isfinite(parameters).all() or not len(errors) else len(errors) - 1
