"""Plans and updates of a user's own in numpy, between the compiled steps of a trial."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import numpy as np

from dopt.control.task import Feedback
from dopt.custom_planner import custom_planner
from dopt.errors import SpecificationError
from dopt.kernel import model_queries
from dopt.kernel.held_trial import HeldTrial
from dopt.kernel.information.primal import dense
from dopt.kernel.pointers import compiled_step
from dopt.kernel.structs import Trial
from dopt.learning.base import CustomLearner, Updater, check_update
from dopt.policies.base import Planner, check_choice
from dopt.randomness import stream
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System, with_inputs
from dopt.trial_view import TrialView
from dopt.types import Array, CompiledFunction


class NumpyParts:
    """The plan and the updates of one trial that are written in numpy, if it has such parts.

    Attributes
    ----------
    targets : (T, r)
        Accelerations observed in each step.
    """

    def __init__(self, spec: TrialSpec, trial: Trial, held: HeldTrial) -> None:
        self._spec, self._trial, self._held = spec, trial, held
        self._queries: dict[CompiledFunction, CompiledFunction] = {}
        policy, learner, system = spec.policy, spec.learner, spec.system
        self._planner: Planner | None = None
        self._updater: Updater | None = None
        if policy.is_in_numpy():
            self._planner = custom_planner(spec)
        if learner.is_in_numpy() and isinstance(learner, CustomLearner):
            self._updater = learner.updater(system, stream(spec.seed, "updater"))
        self.targets = np.full((system.horizon, system.n_learned), np.nan)

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
        start, theta = time.perf_counter(), self._trial.state.theta
        updated = np.asarray(self._updater.update(self._view(t + 1)), dtype=np.float64)
        seconds = time.perf_counter() - start
        check_update(self._spec.learner.name, updated, theta.shape)
        theta[:] = updated
        return 1e6 * seconds

    def note(self, t: int) -> float:
        """Let the plan take in step t, which was learned from, and return its time [µs]."""
        start = time.perf_counter()
        if self._planner:
            self._planner.observe(self._view(t + 1))
        return 1e6 * (time.perf_counter() - start)

    def _view(self, t: int) -> KernelTrialView:
        return KernelTrialView(self._spec.system, self._trial, self.targets, t, self._ask)

    def _ask(self, query: CompiledFunction, *arrays: Array) -> None:
        """Call a function of the model, which is compiled when it is first asked."""
        if query not in self._queries:
            self._queries[query] = compiled_step(self._trial, query)
        self._queries[query](self._held, *arrays)


class KernelTrialView(TrialView):
    """A trial of the kernel after t steps; its arrays cannot be written into.

    ``ask`` calls a function of :mod:`dopt.kernel.model_queries` with arrays.
    """

    def __init__(
        self, system: System, trial: Trial, targets: Array, t: int, ask: Callable[..., None]
    ) -> None:
        record, state = trial.record, trial.state
        self.system, self.t = system, t
        self._ask, self._size = ask, len(state.theta)
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
        out = np.empty((len(points), self.system.n_learned))
        self._ask(model_queries.write_accelerations, points, out)
        return out

    def jacobian(self, state: Array) -> Array:
        point = _given("a state", state, self._point_size)
        out = np.empty((self.system.n_learned, self._size))
        self._ask(model_queries.write_jacobian, point[None], out)
        return out

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        point = _given("a state", state, self._point_size)
        along = _given("directions", directions, None, self._point_size)
        out = np.empty((len(along), self.system.n_learned, self._size))
        self._ask(model_queries.write_jacobian_change, point, along, out)
        return out

    @property
    def covariance(self) -> Array:
        if not self._covariance.upper.shape[0]:
            raise SpecificationError(
                "a plan asked for the covariance of the parameters, but the trial holds no matrix "
                "M of all of them: derive the policy from InformationPolicy with the form 'primal'."
            )
        return dense(self._covariance) * self._row_scale**2

    def following(self, state: Array, inputs: Array) -> Array:
        x = _given("a state", state, self.system.n_states)
        u = _given("inputs", inputs, None, self.system.n_inputs)
        out = np.empty((len(u), self.system.n_states))
        self._ask(model_queries.write_following, x, u, out)
        return out

    def input_matrix(self, state: Array) -> Array:
        x = _given("a state", state, self.system.n_states)
        out = np.empty((self.system.n_inputs, self.system.n_states))
        self._ask(model_queries.write_input_matrix, x, out)
        return out.T


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
