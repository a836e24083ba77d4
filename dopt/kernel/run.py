"""Runs of a trial in the compiled kernel: whole, in pieces, or step by step; and forecasts.

Where parts are written in numpy, or states come from outside, the interpreter takes the steps one
by one. Forecasts follow many paths at once, under a model or the truth
(:mod:`dopt.control.planning`).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numba import float64

from dopt.control.planning import Forecast
from dopt.control.task import Feedback
from dopt.custom_planner import custom_planner, custom_updater
from dopt.errors import SpecificationError
from dopt.kernel import loop
from dopt.kernel.evidence import Evidence, is_tuned
from dopt.kernel.from_spec import network_of, plant_of, points_of_trial, shared_points, trial_of
from dopt.kernel.held import FIELDS, HeldTrial, HeldTrialType, hold
from dopt.kernel.integration import follow_equations, follow_network
from dopt.kernel.linear_algebra import dense
from dopt.kernel.pointers import (
    BETWEEN,
    STEPS,
    compiled_for,
    compiled_step,
    compiled_trial,
    kind_of,
)
from dopt.kernel.structs import Evaluation
from dopt.learning.base import check_update
from dopt.models import MLP
from dopt.models.base import Model
from dopt.policies.base import CompiledPolicy, check_choice, check_norms
from dopt.randomness import draw, episode_seed
from dopt.result import TrialResult
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System, with_inputs
from dopt.systems.black_box import BlackBox, new_start, start_variances
from dopt.trial_view import TrialView
from dopt.types import Array, CompiledFunction


class NumpyParts:
    """The plan and the updates of one trial that are written in numpy, if it has such parts.

    Attributes
    ----------
    targets : (T, r)
        Accelerations observed in each step.
    """

    def __init__(self, steps: KernelState) -> None:
        spec = self._spec = steps.spec
        self._steps = steps
        self._planner = custom_planner(spec) if spec.policy.is_in_numpy() else None
        self._updater = custom_updater(spec) if spec.learner.is_in_numpy() else None
        self.targets = np.full((spec.system.horizon, spec.system.n_learned), np.nan)

    @staticmethod
    def needed_by(config: TrialConfig) -> bool:
        """Return whether the policy or the learner is written in numpy."""
        return config.policy.is_in_numpy() or config.learner.is_in_numpy()

    @property
    def feedback(self) -> Feedback | None:
        """The law of feedback that the plan has learned; None where it learns none."""
        return self._planner.feedback() if self._planner else None

    def choose(self, t: int, u: Array) -> float:
        """Write the input, (m,), that the plan chooses at x_t, and return its time [µs].

        Raises
        ------
        SpecificationError
            If it has the wrong shape or a norm above γ.
        """
        if self._planner is None or t == 0:
            return 0.0
        start = time.perf_counter()
        chosen = np.asarray(self._planner.choose(self._view(t)), dtype=np.float64)
        seconds = time.perf_counter() - start
        check_choice(self._spec.policy.name, chosen, t, self._spec.system)
        u[:] = chosen
        return 1e6 * seconds

    def update(self, t: int) -> float:
        """Write the parameters that the learner returns after step t, and return its time [µs].

        Raises
        ------
        SpecificationError
            If there are not as many as before.
        """
        if self._updater is None:
            return 0.0
        start, theta = time.perf_counter(), self._steps.state.theta
        updated = np.asarray(self._updater.update(self._view(t + 1)), dtype=np.float64)
        seconds = time.perf_counter() - start
        check_update(self._spec.learner.name, updated, theta.shape)
        theta[:] = updated
        return 1e6 * seconds

    def note(self, t: int) -> float:
        """Tell the plan about step t, which was learned from; return the time taken [µs]."""
        start = time.perf_counter()
        if self._planner:
            self._planner.observe(self._view(t + 1))
        return 1e6 * (time.perf_counter() - start)

    def _view(self, t: int) -> KernelTrialView:
        return KernelTrialView(self._steps, self.targets, t)


class KernelTrialView(TrialView):
    """A trial of the kernel after t steps; its arrays cannot be written into."""

    def __init__(self, steps: KernelState, targets: Array, t: int) -> None:
        trial, system = steps.trial, steps.spec.system
        record, state = trial.record, trial.state
        self.system, self.t = system, t
        self._call, self._size = steps.call, len(state.theta)
        self._covariance, self._row_scale = state.covariance, trial.algorithm.search.row_scale
        self._point_size = system.n_states + trial.network.n_inputs_read
        self.states, self.inputs = _fixed(record.states[: t + 1]), _fixed(record.inputs[:t])
        self.sampled_inputs = _fixed(state.estimate.inputs[:t])
        self.accelerations = _fixed(targets[:t])
        self.parameters = state.theta.copy()
        last, ties = t == system.horizon, trial.randomness.ties
        self.tie = np.full(system.n_inputs, np.nan) if last else _fixed(ties[t])

    @functools.cached_property
    def sampled(self) -> Array:  # type: ignore[override]  # computed where it is asked for
        """States at which the accelerations were observed, (t, d)."""
        return self.system.sampled_states(self.states)

    def points(self, states: Array, inputs: Array) -> Array:
        return with_inputs(states, inputs, self._point_size - self.system.n_states)

    def predict(self, states: Array) -> Array:
        points = _given("states", states, None, self._point_size)
        return self._asked(loop.write_accelerations, (len(points), self.system.n_learned), points)

    def jacobian(self, state: Array) -> Array:
        point = _given("a state", state, self._point_size)
        shape = self.system.n_learned, self._size
        return self._asked(loop.write_jacobian, shape, point[None])

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        point = _given("a state", state, self._point_size)
        along = _given("directions", directions, None, self._point_size)
        shape = len(along), self.system.n_learned, self._size
        return self._asked(loop.write_jacobian_change, shape, point, along)

    @property
    def covariance(self) -> Array:
        if not self._covariance.size:
            raise SpecificationError(
                "a plan asked for the covariance of the parameters, but the trial holds no matrix "
                "M of all of them: derive the policy from InformationPolicy with the form 'primal'."
            )
        return dense(self._covariance) * self._row_scale**2

    def following(self, state: Array, inputs: Array) -> Array:
        x = _given("a state", state, self.system.n_states)
        u = _given("inputs", inputs, None, self.system.n_inputs)
        return self._asked(loop.write_following, (len(u), self.system.n_states), x, u)

    def input_matrix(self, state: Array) -> Array:
        x = _given("a state", state, self.system.n_states)
        shape = self.system.n_inputs, self.system.n_states
        return self._asked(loop.write_input_matrix, shape, x).T

    def _asked(self, query: CompiledFunction, shape: tuple[int, ...], *arrays: Array) -> Array:
        """Return the array that a function of the model writes, given others."""
        out = np.empty(shape)
        self._call(query, *arrays, out)
        return out


def _given(what: str, values: Array, *shape: int | None) -> Array:
    """Return an array of a shape, contiguous: compiled code reads it without a check.

    Raises
    ------
    SpecificationError
        If it has another shape; None stands for any size.
    """
    array = np.ascontiguousarray(values, dtype=np.float64)
    sizes = zip(array.shape, shape, strict=False)
    if array.ndim != len(shape) or any(expected not in (None, size) for size, expected in sizes):
        expected = ", ".join("N" if size is None else str(size) for size in shape)
        raise SpecificationError(
            f"a plan or an update asked the model about {what} of shape {array.shape}, but "
            f"({expected}{',' if len(shape) == 1 else ''}) is expected: correct it."
        )
    return array


def _fixed(values: Array) -> Array:
    """Return a view that cannot be written into: what was observed stays."""
    view = values[:]
    view.flags.writeable = False
    return view


class KernelState:
    """A trial in the compiled kernel: its observations, its learned parameters and its code.

    Attributes
    ----------
    trial : Trial
        Arguments of the compiled functions.
    state, record : State, Record
        Its arrays that they write in place.
    points : Evaluation or None
        Points at which the model is compared with the truth, where there is one.
    done : int
        Number of steps done.
    diverged_at : int or None
        Step at which the trial diverged.
    """

    callers: ClassVar[tuple[CompiledFunction, ...]] = (hold, loop.advance)
    also_called: ClassVar[tuple[CompiledFunction, ...]] = ()
    points: Evaluation | None = None
    done: int = 0
    diverged_at: int | None = None

    def __init__(self, spec: TrialSpec) -> None:
        draws = draw(spec)
        self.spec, self.trial = spec, trial_of(spec, draws)
        self.state, self.record = self.trial.state, self.trial.record
        self.evidence = Evidence(spec, self.trial) if is_tuned(spec.model) else None
        n_fixed = spec.model.n_fixed_parameters(spec.system)
        self._fixed = draws.weights[len(draws.weights) - n_fixed :]
        self._code: dict[CompiledFunction, CompiledFunction] = {}

    @functools.cached_property
    def held(self) -> HeldTrial:
        """The trial as compiled code holds it."""
        spec = self.spec
        between = BETWEEN if NumpyParts.needed_by(spec.config) else ()
        others = (*self.also_called, *between)
        parts = spec.policy, spec.learner, self.trial
        steps, code = compiled_trial(*parts, self.callers, self.points, others)
        self._code |= zip(self.callers, code, strict=True)
        held: HeldTrial = self._code[hold](self.trial, steps)
        return held

    def call(self, function: CompiledFunction, *given: object) -> Any:
        """Call a function of :mod:`dopt.kernel.loop`, which is compiled when it is first called."""
        if function not in self._code:
            self._load(function)
        return self._code[function](self.held, *given)

    def _load(self, function: CompiledFunction) -> None:
        _ = self.held  # which compiles what the cache lacks, all at once
        self._code[function] = compiled_step(self.trial, function, self.points)

    def _check_inputs(self, first: int, last: int) -> None:
        """Refuse inputs larger than γ from a compiled policy in a user's file."""
        policy, inputs = self.spec.policy, self.record.inputs[first:last]
        if isinstance(policy, CompiledPolicy):
            check_norms(policy.name, inputs, first, self.spec.system.gamma)

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,), of all members, and those that stay as they were drawn."""
        if self.state.members.parameters.shape[0] > 0:
            return self.state.members.parameters.flatten()
        return np.concatenate([self.state.theta, self._fixed])

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet.

        Of a simulation they are the true ones.
        """
        return self.record.true_states


class KernelSteps(KernelState):
    """The compiled steps of a trial: the caller says what state a plant has and what follows.

    The states and the inputs of the record are theirs to write.
    """

    callers = STEPS
    also_called: ClassVar[tuple[CompiledFunction, ...]] = (loop.write_reached,)

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        if spec.system.n_measured:
            self.trial.sensors.start_variances[:] = start_variances(spec.system)
        self._parts = NumpyParts(self) if NumpyParts.needed_by(spec.config) else None
        taken = (loop.observe_next, loop.learn_next) if self._parts else ()
        for function in (*taken, *self.also_called):  # no step waits for its code then
            self._load(function)

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, known or estimated, (T + 1, d)."""
        return self.record.states

    @property
    def inputs(self) -> Array:
        """Inputs u_0 ... u_{T-1}, (T, m)."""
        return self.record.inputs

    @property
    def learned_inputs(self) -> Array:
        """Inputs beside the states that are learned from, late as a filter of these, (T, m)."""
        return self.state.estimate.inputs

    @property
    def errors(self) -> Array:
        """Errors of the accelerations before they were learned, (T,)."""
        return self.record.loss

    def begin(self, t: int, state: Array) -> None:
        """Begin step t at a state, (d,), whatever came before it."""
        self.record.states[t] = state
        if len(self.state.estimate.starts):
            self.state.estimate.starts[t] = state

    def replace(self, parameters: Array, constants: Array) -> None:
        """Take other parameters of the model, (q,), and other constants of the system."""
        self.state.theta[:] = parameters
        self.trial.plant.parameters[:] = constants

    def measure(self, t: int, measured: Array) -> None:
        """Write what was measured after step t: x_{t+1}, (d,), or the outputs, (n,)."""
        known = not self.spec.system.n_measured
        into = self.record.states[t + 1] if known else self.state.estimate.outputs[t]
        into[:] = measured

    def reached(self, t: int, inputs: Array, seconds: Array) -> Array:
        """Return the state, (d,), predicted from x_t after inputs (n, m) held for times (n,)."""
        state: Array = np.empty(self.spec.system.n_states)
        self.call(loop.write_reached, self.record.states[t], inputs, seconds, state)
        return state

    def note_asked(self, u: Array) -> None:
        """Count limits of rates from an input, (m,), in place of what acted."""
        if len(self.state.prediction.last_input):
            self.state.prediction.last_input[:] = u

    def plan_input(self, t: int) -> None:
        """Write the input u_t that the policy chooses at x_t."""
        chosen_in = self._parts.choose(t, self.record.inputs[t]) if self._parts else 0.0
        self.call(loop.plan_next, t)
        self.record.plan_us[t] += chosen_in

    def take_in(self, t: int, dt: float) -> bool:
        """Learn from x_t, u_t and x_{t+1}, which came dt seconds later.

        Returns whether the parameters are finite.
        """
        if self._parts is None:
            return bool(self.call(loop.take_in_next, t, dt))
        target = self._parts.targets[t]
        self.call(loop.observe_next, t, dt, target)
        updated_in = self._parts.update(t)
        finite = bool(self.call(loop.learn_next, t, target))
        self.record.learn_us[t] += updated_in
        if finite:
            self.record.plan_us[t] += self._parts.note(t)
        return finite


def is_stepped(config: TrialConfig) -> bool:
    """Return whether the interpreter takes the steps of a trial one by one."""
    return isinstance(config.system, BlackBox) or NumpyParts.needed_by(config)


class SteppedTrial(KernelSteps):
    """A trial in steps, with the attributes of :class:`dopt.kernel.run.KernelTrial`."""

    also_called = (loop.evaluate_next,)

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        self._episode = None
        if isinstance(spec.system, BlackBox):
            self._episode = spec.system.episode(episode_seed(spec.seed))
            self.begin(0, self._episode.state)

    @functools.cached_property
    def points(self) -> Evaluation:  # type: ignore[override]  # which a trial has, other steps not
        return points_of_trial(shared_points(self.spec.config), self.trial.network)

    @property
    def feedback(self) -> Feedback | None:
        """The law of feedback that the policy has learned; None where it learns none."""
        return self._parts.feedback if self._parts else None

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged."""
        while self.done < last and self.diverged_at is None:
            if self._step(self.done):
                self.done += 1
            else:
                self.diverged_at = self.done

    def _step(self, t: int) -> bool:
        """Take step t, and return whether the trial goes on."""
        self.plan_input(t)
        self._check_inputs(t, t + 1)
        inside, dt = self._go_on(t), self.spec.system.dt
        goes_on = inside and self.take_in(t, dt) and self.call(loop.evaluate_next, self.points, t)
        if goes_on and self.evidence and t + 1 == self.evidence.due:
            self.record.learn_us[t] += self.evidence.fit(self.points)
        return goes_on

    def _go_on(self, t: int) -> bool:
        """Advance the system to x_{t+1}, and return whether that is within its limit."""
        if self._episode is None:
            return bool(self.call(loop.act_next, t))
        self.inputs[t] = self._episode.step(self.inputs[t].copy())
        if (start := new_start(self._episode)) is not None:
            self.begin(t, start)
        following = self.record.states[t + 1]
        following[:] = self._episode.state
        return bool(np.all(np.abs(following) <= self.spec.system.state_limit))  # false for NaN


FIRST_STEPS = 300
"""Steps of a trial before it is known what a step costs; trials of the paper have no more."""

PIECE_SECONDS = 1.0
"""Interval at which compiled code returns to the interpreter, so that signals are handled."""


class KernelTrial(KernelState):
    """A simulated trial, which can be advanced in pieces and looked at in between."""

    points: Evaluation
    feedback: Feedback | None = None  # no compiled policy learns one

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        self.points = points_of_trial(shared_points(spec.config), self.trial.network)

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged.

        Raises
        ------
        SpecificationError
            If ``last`` lies beyond the horizon.
        """
        if last > self.spec.system.horizon:
            raise SpecificationError(
                f"step {last} was asked for, but the horizon is {self.spec.system.horizon}: raise "
                f"env.horizon."
            )
        if self.diverged_at is not None or last <= self.done:
            return
        before = self.done
        while self.done < last and self.diverged_at is None:
            stop = min(last, self.evidence.due) if self.evidence else last
            self.done = self.call(loop.advance, self.points, self.done, stop)
            if self.done < stop:
                self.diverged_at = self.done
            elif self.evidence and self.done == self.evidence.due:
                self.record.learn_us[self.done - 1] += self.evidence.fit(self.points)
        self._check_inputs(before, self.done)


def run_trial_in_kernel(spec: TrialSpec) -> TrialResult:
    """Run a whole trial in compiled code."""
    wall, cpu = time.perf_counter(), time.process_time()
    trial = trial_in_kernel(spec)
    checkpoints: dict[int, Array] = {}
    feedbacks: dict[int, Feedback] = {}
    for step in spec.assessed_steps:
        _advance_in_pieces(trial, step)
        if trial.diverged_at is None:
            checkpoints[step] = trial.parameters
            if (feedback := trial.feedback) is not None:
                feedbacks[step] = feedback
    _advance_in_pieces(trial, spec.system.horizon)
    record, end = trial.record, trial.diverged_at
    if end is not None:
        for rows in record:
            rows[end:] = np.nan
    columns = record._asdict()
    columns["states"] = columns.pop("true_states")
    if spec.system.n_measured:
        columns["estimated_states"] = record.states
    return TrialResult(
        **columns,
        parameters=trial.parameters,
        diverged_at=end,
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        checkpoints=checkpoints,
        feedbacks=feedbacks,
    )


def trial_in_kernel(spec: TrialSpec) -> KernelTrial | SteppedTrial:
    """Return a trial before its first step."""
    return SteppedTrial(spec) if is_stepped(spec.config) else KernelTrial(spec)


def _advance_in_pieces(trial: KernelTrial | SteppedTrial, last: int) -> None:
    """Run a trial up to a step; the numbers do not depend on where it is cut."""
    steps = FIRST_STEPS
    while trial.done < last and trial.diverged_at is None:
        before, start = trial.done, time.perf_counter()
        trial.advance(min(last, before + steps))
        rate = (trial.done - before) / (time.perf_counter() - start)
        steps = max(1, int(rate * PIECE_SECONDS))


def true_forecast(system: System) -> Forecast:
    """Return the forecast of the system itself, as it is at the first step."""
    return _by_equations(system, system.history[0])


def model_forecast(system: System, model: Model, parameters: Array) -> Forecast:
    """Return the forecast of a model of the kernel with parameters (q,)."""
    if isinstance(model, MLP):
        thetas = np.reshape(parameters, (model.n_members, -1)).copy()
        given = (network_of(system, model), thetas)
        return _forecast(follow_network, system, given)
    # The accelerations are affine in θ, so that the linear model is the system with θ for its own.
    offset, *units = np.array(system.linear_form)
    return _by_equations(system, offset + parameters @ (np.array(units) - offset))


def _by_equations(system: System, parameters: Array) -> Forecast:
    return _forecast(follow_equations, system, (np.array(parameters),))


def _forecast(function: Callable[..., None], system: System, given: tuple[object, ...]) -> Forecast:
    whole = plant_of(system), 0  # a plant calls nothing
    kinds = tuple(map(kind_of, whole))
    held = compiled_for(hold, kinds)(*whole)
    kind = HeldTrialType(list(zip(FIELDS, kinds, strict=True)))
    stacks = [float64[:, :, ::1]] * 2
    follow = compiled_for(function, (kind, *map(kind_of, given), *stacks))

    def forecast(states: Array, inputs: Array) -> Array:
        n, steps, _ = inputs.shape
        visited = np.empty((steps + 1, n, states.shape[1]))
        visited[0] = states
        by_step = np.ascontiguousarray(inputs.swapaxes(0, 1))
        follow(held, *given, by_step, visited)
        return visited[1:]

    return forecast
