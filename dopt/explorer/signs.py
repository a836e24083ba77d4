"""Signs that an exploration fails: counted by its events alone, and each said once.

Errors are of accelerations, with their signs, by parameters at most 50 steps old. For each learned
row and each input the share of their squares is taken that the input of the eight steps before
explains, or the inputs that do not act yet as the delay is declared, beyond a constant, the
features of x_t and the inputs u_t, on which alone a plant depends that answers at once. Estimated
states depend on earlier inputs by their filter: where they are, second differences of the
measurements take the place of errors, and u_{t-1} is given as well.

Free runs over the last steps are predicted by the learned model, and by the known part alone. Where
a low-pass filter estimates the states, they begin, end and are driven as it has them, late alike.

Tests take as long as several steps of a plant. A part of one is done after each learned step, with
the model and the states as they were when it began, and what is left at the end.
"""

from __future__ import annotations

import functools
import logging
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from dopt.control.planning import predict, relative_error
from dopt.errors import counted
from dopt.explorer.journal import Event
from dopt.learning import SimulationError
from dopt.models.gaussian_process import GaussianProcess
from dopt.spec.scaled import scaled
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array

SIGNS = {
    "unmoved": "stretches of 100 learned steps in which no parameter moved",
    "late": "stretches of 300 steps whose errors follow from earlier inputs",
    "early": "stretches of 300 steps whose errors follow from inputs that are not to act yet",
    "worse": "tests in which the learned model predicted worse than the known part alone",
    "altered": "learned steps in which another input was applied than was asked",
    "supply": "fits that found a level beyond which inputs act no more",
    "out_of_scale": "learned accelerations of another size than a network learns",
    "beyond": "states beyond the limits",
    "narrow": "sides of the box of which the first 500 states cover less than a tenth",
}
"""Meaning of the counts."""

STORED = {name: said for name, said in SIGNS.items() if name != "beyond"}
"""Signs that are stored by these names; states beyond limits are stored as violations."""

BLOCK = 50
"""Steps after which parameters are compared; one set of parameters predicts so many."""

PART = 10
"""Steps whose errors are taken together, after one learned step."""

FIRST, TESTED, EVERY = 200, 300, 3000
"""Steps before tests for earlier inputs, while much is left to learn; fewest of a test; and steps
from two tests to the next two."""

LAGS = 8
"""Longest lag that is tested, in steps; tested steps follow so many others without a gap."""

RUNS, AHEAD, TRIED = 8, 50, 500
"""Free runs of a test, the steps of each, and steps from one test to the next."""

WORSE = 1.25
"""Error of the learned model, by the one of the known part, that is said."""

EXPLAINED, OF_MOTION = 0.14, 0.25
"""Share of the squares of the errors, and its size beside the accelerations', that are said.

Noise has the share in one test of an input in 500,000.
"""

FOLLOWS = 1e-6
"""Share of the squares of an input, beyond what is given, that counts as none."""

MANY, COMMON = 20, 0.1
"""Altered inputs, and their share of all, that are said."""

ROUNDING = 1e-9
"""Difference of two inputs, in units of γ, that counts as none."""

COVERED, AFTER = 0.1, 500
"""Share of a side of the box that so many states are expected to cover."""

_log = logging.getLogger("dopt.explorer")

_TEXTS = {
    "unmoved": "no parameter moved in the last 100 learned steps, but each step is expected to "
    "correct the model (%s): raise the regularization or the noise variance of the learner, or "
    "take another one such as 'adam_window'",
    "late": "the errors of the predictions follow from inputs of earlier steps, most from the one "
    "%s before (together %.0f %% of their squares), but the plant is expected to answer at "
    "once, or as declared: declare Plant(delay=..., lag=...), or let learner='simulation_error' "
    "fit them (dopt.unknown)",
    "early": "the errors of the predictions follow from inputs that are not to act yet, most from "
    "the one %s before (together %.0f %% of their squares), but the plant is expected to "
    "answer as late as declared: declare a shorter delay, or let learner='simulation_error' fit it "
    "(dopt.unknown)",
    "worse": "%d steps ahead the learned model predicts with %.3g times the error of the known "
    "part alone, but it is expected to help: let 'joint_ekf' or 'simulation_error' learn, which "
    "estimate states, or raise velocity_cutoff or the noise variance",
    "altered": "another input than ask() returned was applied in %d of %d steps, but plans count "
    "on theirs: declare Plant(supply=...) if inputs are cut, or lower gamma",
    "supply": "inputs beyond %.3g act no more than that does, but all are expected to act as "
    "asked: plans are cut there from here on; declare Plant(supply=...), also if it is another one",
    "beyond": "a state was beyond the limits by %.3g after %d steps, but inputs are chosen so that "
    "none is: raise their margin or steps, and check the known part",
    "narrow": "the first 500 states cover %.2g %% of the box along %s, but the model is to hold in "
    "all of it: declare a smaller box, raise gamma, or choose another policy",
}


class Steps(Protocol):
    """Steps of an exploration that signs read, in scaled numbers."""

    @property
    def states(self) -> Array: ...
    @property
    def inputs(self) -> Array: ...
    @property
    def learned_inputs(self) -> Array: ...
    @property
    def parameters(self) -> Array: ...


class Exploration(Protocol):
    """State of an exploration that signs read; they change its counts."""

    done: int
    counts: Counter[str]
    states: Array
    excess: Array
    answer: Array | None
    was_asked: bool
    system: System

    @property
    def steps(self) -> Steps: ...
    @property
    def waiting(self) -> Array: ...


class Signs:
    """Counts of the signs, in the counts of an exploration.

    Parameters
    ----------
    spec : TrialSpec
        Plant, model and limits.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self._spec = spec
        self._parameters: Array | None = None  # at the beginning of the block
        self._still = 0  # blocks in a row that left them as they were
        self._start = 0  # first of the steps that followed each other
        # of the last steps: start, time, measurement, waiting
        self._steps = deque[tuple[int, float, Any, Array]](maxlen=max(TESTED, RUNS * AHEAD))
        self._models: list[Array] = []  # parameters at the beginning of each block of a test
        self._rows: list[tuple[Array, ...]] = []  # of the next test
        self._tests: deque[Iterator[None]] = deque()  # that are not done, part by part
        self._told: set[str] = set()

    def restart(self, t: int) -> None:
        """Begin at step t from a state that need not follow the one before."""
        self._start = t

    def learned(self, state: Exploration, event: Event, seconds: float) -> None:
        """Count after a step of so many seconds was learned from."""
        done, limits, asked = state.done, self._spec.limits, state.answer
        if state.was_asked and asked is not None and event["applied"] != asked.tolist():
            self._compare(np.array(event["applied"]) - asked, state)
        if limits is not None and state.excess[done - 1] > 0.0:
            state.counts["beyond"] += 1
            if limits.enforced:
                self._say("beyond", state.excess[done - 1], done)
        self._steps.append((self._start, seconds, event["learn"], state.waiting))
        if done % BLOCK == 0:
            self._end_block(state)
        if done % TRIED == 0:
            self._begin(self._compare_runs(state))
        if done == AFTER:
            self._measure_box(state)
        if done == self._spec.system.horizon:
            self.finish()
        elif self._tests:
            has_ended = next(self._tests[0], True)
            if has_ended:
                self._tests.popleft()

    def finish(self) -> None:
        """Do what is left of the tests."""
        while self._tests:
            for _ in self._tests.popleft():
                pass

    def find_supply(self, state: Exploration, level: float) -> None:
        """Count a fit that found a supply which the plant does not declare."""
        state.counts["supply"] += 1
        self._say("supply", level)

    def _compare(self, change: Array, state: Exploration) -> None:
        """Count an input that was not applied as it was asked."""
        if np.abs(change).max() <= ROUNDING * self._spec.system.gamma:
            return
        state.counts["altered"] += 1
        if (n := state.counts["altered"]) >= max(MANY, COMMON * state.done):
            self._say("altered", n, state.done)

    def _end_block(self, state: Exploration) -> None:
        before, self._parameters = self._parameters, np.array(state.steps.parameters)
        learner, model = self._spec.learner, self._spec.model  # some move them now and then
        refitted = isinstance(learner, SimulationError)
        refitted |= isinstance(model, GaussianProcess) and model.is_tuned
        same = before is not None and np.array_equal(before, self._parameters) and not refitted
        self._still = self._still + 1 if same else 0
        if self._still and self._still % (100 // BLOCK) == 0:
            state.counts["unmoved"] += 1
            self._say("unmoved", learner.name)
        tested = 0 < (state.done - FIRST) % EVERY <= 2 * TESTED
        if not tested or before is None:
            return
        self._models.append(before)
        if len(self._models) == TESTED // BLOCK:
            self._begin(self._test_inputs(state, [*self._steps][-TESTED:], self._models))
            self._models = []

    def _begin(self, test: Iterator[None]) -> None:
        """Begin a test, which copies what it needs of the exploration as it is now."""
        if next(test, True) is None:
            self._tests.append(test)

    def _compare_runs(self, state: Exploration) -> Iterator[None]:
        """Count where the learned model predicts the last states worse than without it."""
        found, predicted, steps = scaled(state.system), self._spec.model.predict, state.steps
        starts = [start for start, *_ in self._steps][-RUNS * AHEAD :]
        first, last = state.done - len(starts), len(starts) - 1
        each = range(0, last + 2 - AHEAD, AHEAD)
        at = [t for t in each if starts[min(t + AHEAD, last)] <= first + t]
        if not at:
            return
        rows = first + np.array(at)[:, None] + np.arange(AHEAD)
        estimates = self._spec.learner.estimates_states  # with the model
        seen = (estimates and list(found.system.measured_states)) or slice(None)
        x0, u = steps.states[rows[:, 0]], steps.inputs[rows]
        if self._spec.system.n_measured and not estimates:
            u = steps.learned_inputs[rows]
        ends = steps.states[rows + 1][..., seen].swapaxes(0, 1)
        parameters = np.array(steps.parameters)

        def both(x: Array, u: Array) -> Array:  # the learned accelerations, and none
            n = len(x) // 2
            own = predicted(found.system, parameters, x[:n], u[:n])
            return np.concatenate([own, np.zeros_like(own)])

        reached, x = np.empty((AHEAD, 2 * len(at), x0.shape[1])), np.tile(x0, (2, 1))
        for k in range(AHEAD):
            yield
            held = np.tile(u[:, k : k + 1], (2, 1, 1))
            with np.errstate(all="ignore"):
                reached[k] = x = predict(found.system, both, x, held)[0]
        learned, known = (
            relative_error(half[..., seen], ends, x0[:, seen])
            for half in np.split(reached, 2, axis=1)
        )
        if known < np.inf and not learned <= WORSE * known:
            state.counts["worse"] += 1
            self._say("worse", AHEAD, learned / known)

    def _test_inputs(
        self, state: Exploration, steps: Sequence[tuple[Any, ...]], models: Sequence[Array]
    ) -> Iterator[None]:
        """Count where inputs of earlier steps explain errors, once there are enough of these.

        What is given (N, p), the earlier inputs and those that do not act yet, from the newest on,
        (N, m, L) each, are taken beside the errors (N, r) and the accelerations (N, r) of the last
        steps, where these follow others without a gap.
        """
        found, first, inputs = scaled(state.system), state.done - TESTED, state.steps.inputs
        x, u = state.steps.states[first : state.done + 1].copy(), inputs[first:]
        *facts, waiting = zip(*steps, strict=True)
        starts, seconds, measured = map(np.array, facts)
        system = found.system
        differ = 1 if self._spec.system.n_measured else 0
        if differ:
            y = found.of_states(measured, list(system.measured_states))
            slopes = np.diff(y, axis=0, prepend=y[:1]) / seconds[:, None]
            errors = moved = np.diff(slopes, axis=0, prepend=slopes[:1])
        else:
            moved = ((x[1:] - x[:-1]) / seconds[:, None])[:, list(system.learned_rows)]
            errors = np.empty_like(moved)
            for k in range(0, TESTED, PART):
                at = slice(k, k + PART)
                yield
                errors[at] = moved[at] - self._flow(system, models[k // BLOCK], x[at], u[at])
        t = np.arange(first, first + TESTED)
        t = t[(t - starts >= LAGS + differ) & np.append(starts[1:] == starts[:-1], True)]
        at = t[t - first >= 2 * differ] - first  # of which there are such differences
        last = np.hstack([u[at - k] for k in range(1 + differ)])
        angles, ones = list(system.angle_indices), np.ones((len(at), 1))
        turned, others = x[at][:, angles], np.delete(x[at], angles, axis=1)
        given = np.hstack([ones, others, np.cos(turned), np.sin(turned), last])
        lags = first + at - differ - np.arange(1, LAGS + 1)[:, None]
        n = min(map(len, waiting))  # the delay may have changed
        later = np.array([one[:n] for one in waiting])[at]
        lagged = np.moveaxis(inputs[lags], 0, -1), np.moveaxis(later, 1, -1)
        self._rows.append((errors[at], moved[at], given, *lagged))
        if sum(len(errors) for errors, *_ in self._rows) >= TESTED - 2 * differ:
            *rows, later = zip(*self._rows, strict=True)
            n = min(part.shape[-1] for part in later)
            rows.append(tuple(part[..., :n] for part in later))
            self._rows = []
            yield from self._test(state, [*map(np.concatenate, rows)])

    def _flow(self, system: System, parameters: Array, x: Array, u: Array) -> Array:
        """Return the mean accelerations of a predicted step, (n, r)."""
        accelerations = functools.partial(self._spec.model.predict, system, parameters)
        with np.errstate(all="ignore"):
            following = predict(system, accelerations, x, u[:, None])[0]
            flow: Array = (following - x) / system.dt
            return flow[:, list(system.learned_rows)]

    def _test(self, state: Exploration, rows: Sequence[Array]) -> Iterator[None]:
        """Count where inputs of earlier steps explain errors, or ones that are not to act yet."""
        errors, moved, given, earlier, later = rows
        if not (np.isfinite(errors).all() and np.isfinite(given).all()):
            return
        largest, said = 0.0, ("", 0)
        parts = [("late", 1, earlier)]
        parts += [("early", k, later[..., k : k + LAGS]) for k in range(0, later.shape[-1], LAGS)]
        for sign, first, inputs in parts:
            for j in range(inputs.shape[1]):
                yield
                shares, sizes, most = explained(errors, given, inputs[:, j])
                large = sizes >= OF_MOTION * moved.std(axis=0)
                share = float(np.max(shares, where=large, initial=0.0))
                if share > largest:
                    largest, said = share, (sign, first + most)
        if largest >= EXPLAINED:
            sign, samples = said
            state.counts[sign] += 1
            self._say(sign, counted(samples, "sample"), 100.0 * largest)

    def _measure_box(self, state: Exploration) -> None:
        """Count the sides of the box of which the states so far cover little."""
        system, x = self._spec.system, state.states[: state.done + 1]
        for axis, (low, high) in system.grid_box().items():
            covered = float(np.ptp(x[:, axis])) / (high - low)
            if covered < COVERED:
                state.counts["narrow"] += 1
                self._say("narrow", 100.0 * covered, system.state_labels[axis])

    def _say(self, sign: str, *numbers: object) -> None:
        if sign not in self._told:
            self._told.add(sign)
            _log.warning(_TEXTS[sign], *numbers)


def explained(errors: Array, given: Array, earlier: Array) -> tuple[Array, Array, int]:
    """Return what an input of earlier steps explains of errors beyond what is given.

    Parameters
    ----------
    errors, given, earlier : (N, r), (N, p), (N, L)

    Returns
    -------
    shares : (r,)
        Shares of the squares of the errors that all lags explain together.
    sizes : (r,)
        Root mean squares of that part, in the unit of the errors.
    place : int
        Of the lag that alone explains most of what they do.
    """
    basis = np.linalg.qr(given)[0]
    rest = errors - basis @ (basis.T @ errors)
    free = earlier - basis @ (basis.T @ earlier)
    squares = np.sum(free**2, axis=0)
    known = squares <= FOLLOWS * np.sum(earlier**2, axis=0)  # it follows from what is given
    free[:, known], squares[known] = 0.0, np.inf
    alone = np.sum((free.T @ rest) ** 2, axis=1) / squares
    basis, sizes = np.linalg.svd(free, full_matrices=False)[:2]
    basis = basis[:, sizes**2 > FOLLOWS * np.sum(sizes**2)]
    found = np.sum((basis.T @ rest) ** 2, axis=0)
    total = np.maximum(np.sum(rest**2, axis=0), np.finfo(float).tiny)
    return found / total, np.sqrt(found / len(errors)), int(np.argmax(alone))
