"""Signs that an exploration fails: counted by its events alone, and each said once.

Errors are those of accelerations, with their signs, by parameters that are at most 50 steps old. Of
each learned row, each input and each lag k the share ρ² is taken of the errors that u_{t-k}
explains beyond a constant, the features of x_t and u_t, on which alone a plant depends that
answers at once. Estimated states depend on earlier inputs by their filter: of these there is no
such test.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from dopt.control.planning import predict
from dopt.explorer.journal import Event
from dopt.spec.scaled import scaled
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array

if TYPE_CHECKING:
    from dopt.explorer.state import ExplorerState

SIGNS = {
    "unmoved": "stretches of 100 learned steps in which no parameter moved",
    "late": "stretches of 200 learned steps whose errors follow from earlier inputs",
    "altered": "learned steps in which another input was applied than was asked",
    "out_of_scale": "learned accelerations of another size than a network learns",
    "beyond": "states beyond the limits",
    "narrow": "sides of the box of which the first 500 states cover less than a tenth",
}
"""What is counted of each sign."""

BLOCK = 50
"""Steps after which parameters are compared; one set of parameters predicts so many."""

TESTED = 200
"""Steps of a test for earlier inputs."""

FEWEST = 100
"""Fewest of them that follow ``LAGS`` others without a gap."""

LAGS = 8
"""Longest lag that is tested, in steps."""

EXPLAINED, OF_MOTION = 0.25, 0.1
"""Share ρ² of the errors, and its root mean square by the accelerations', which are said."""

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
    "late": "the errors of the predictions follow from inputs of earlier steps, most from that of "
    "%d samples before (%.0f %% of their squares), but the plant is expected to answer at once, or "
    "as declared: declare Plant(delay=..., lag=...)",
    "altered": "another input than ask() returned was applied in %d of %d steps, but plans count "
    "on theirs: declare Plant(supply=...) if inputs are cut, or lower gamma",
    "beyond": "a state was beyond the limits by %.3g after %d steps, but inputs are chosen so that "
    "none is: raise their margin or steps, and check the known part",
    "narrow": "the first 500 states cover %.2g %% of the box along %s, but the model is to hold in "
    "all of it: declare a smaller box, raise gamma, or choose another policy",
}


class Signs:
    """Counts of the signs, in the counts of an exploration.

    Parameters
    ----------
    spec : TrialSpec
        Plant, model and limits.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self._spec, self._system = spec, scaled(spec.system).system
        self._parameters: Array | None = None  # at the beginning of the block
        self._still = 0  # blocks in a row that left them as they were
        self._start = 0  # first of the steps that followed each other
        self._starts: list[int] = []  # that of each step since the last test
        self._seconds: list[float] = []  # time of each of them
        self._errors: list[Array] = []  # (BLOCK, r) of each block of them
        self._told: set[str] = set()

    def note(self, event: Event, state: ExplorerState) -> None:
        """Count what an event says of the state that it is about to change."""
        if "learn" in event:
            asked = state.answer
            if state.was_asked and asked is not None and event["applied"] != asked.tolist():
                self._compare(np.array(event["applied"]) - asked, state)
        elif not event.keys().isdisjoint(("begin", "gap", "lost")):
            self._start = state.done

    def _compare(self, change: Array, state: ExplorerState) -> None:
        """Count an input that was not applied as it was asked."""
        if np.abs(change).max() <= ROUNDING * self._spec.system.gamma:
            return
        state.counts["altered"] += 1
        if (n := state.counts["altered"]) >= max(MANY, COMMON * state.done):
            self._say("altered", n, state.done + 1)

    def learned(self, state: ExplorerState, seconds: float) -> None:
        """Count after a step of so many seconds was learned from."""
        done, limits = state.done, self._spec.limits
        if limits is not None and state.excess[done - 1] > 0.0:
            state.counts["beyond"] += 1
            if limits.enforced:
                self._say("beyond", state.excess[done - 1], done)
        self._starts.append(self._start)
        self._seconds.append(seconds)
        if done % BLOCK == 0:
            self._end_block(state)
        if done == AFTER:
            self._measure_box(state)

    def _end_block(self, state: ExplorerState) -> None:
        before, self._parameters = self._parameters, np.array(state.steps.parameters)
        same = before is not None and np.array_equal(before, self._parameters)
        self._still = self._still + 1 if same else 0
        if self._still and self._still % (100 // BLOCK) == 0:
            state.counts["unmoved"] += 1
            self._say("unmoved", self._spec.learner.name)
        if before is not None and not self._spec.system.n_measured:
            self._errors.append(self._block_errors(state, before))
        if state.done % TESTED == 0:
            if len(self._errors) * BLOCK == TESTED:
                self._test_lags(state)
            self._starts, self._seconds, self._errors = [], [], []

    def _block_errors(self, state: ExplorerState, parameters: Array) -> Array:
        """Return the errors of accelerations, (BLOCK, r), of the steps of a block."""
        system, done, model = self._system, state.done, self._spec.model
        x, u = state.steps.states[done - BLOCK : done + 1], state.steps.inputs[done - BLOCK : done]
        seconds = np.array(self._seconds[-BLOCK:])[:, None]
        with np.errstate(all="ignore"):
            following = predict(
                system, lambda x, u: model.predict(system, parameters, x, u), x[:-1], u[:, None]
            )[0]
            errors = (x[1:] - x[:-1]) / seconds - (following - x[:-1]) / system.dt
        rows: Array = errors[:, list(system.learned_rows)]
        return rows

    def _test_lags(self, state: ExplorerState) -> None:
        first, starts = state.done - TESTED, np.array(self._starts)
        t = first + np.arange(TESTED)
        whole = (t - starts >= LAGS) & np.append(starts[1:] == starts[:-1], True)
        if np.count_nonzero(whole) < FEWEST:
            return
        t, errors = t[whole], np.concatenate(self._errors)[whole]
        seconds = np.array(self._seconds)[whole]
        x, inputs = state.steps.states, state.steps.inputs
        moved = ((x[t + 1] - x[t]) / seconds[:, None])[:, list(self._system.learned_rows)]
        if not (np.isfinite(errors).all() and np.isfinite(moved).all()):
            return
        given = np.hstack([np.ones((len(t), 1)), _features(self._system, x[t]), inputs[t]])
        earlier = np.stack([inputs[t - k] for k in range(1, LAGS + 1)])
        shares, sizes = explained(errors, given, earlier)
        sizes /= np.maximum(moved.std(axis=0), np.finfo(float).tiny)
        shares[sizes < OF_MOTION] = 0.0
        lag = int(np.argmax(shares.max(axis=(1, 2))))
        if shares[lag].max() >= EXPLAINED:
            state.counts["late"] += 1
            self._say("late", lag + 1, 100.0 * shares[lag].max())

    def _measure_box(self, state: ExplorerState) -> None:
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


def explained(errors: Array, given: Array, earlier: Array) -> tuple[Array, Array]:
    """Return what each of several inputs explains of errors beyond what is given.

    Parameters
    ----------
    errors, given : (N, r), (N, p)
    earlier : (L, N, m)

    Returns
    -------
    shares : (L, m, r)
        Squared partial correlations, 0 of inputs that follow from what is given.
    sizes : (L, m, r)
        Root mean squares of the explained part, in the unit of the errors.
    """
    basis = np.linalg.qr(given)[0]
    rest = errors - basis @ (basis.T @ errors)
    free = earlier - basis @ (basis.T @ earlier)
    squares = np.sum(free**2, axis=1)
    squares[squares <= FOLLOWS * np.sum(earlier**2, axis=1)] = np.inf
    found = np.einsum("lnm,nr->lmr", free, rest) ** 2 / squares[..., None]
    total = np.maximum(np.sum(rest**2, axis=0), np.finfo(float).tiny)
    return found / total, np.sqrt(found / len(errors))


def _features(system: System, states: Array) -> Array:
    """Return states, (N, d), with the cosine and the sine in the place of each angle."""
    angles = list(system.angle_indices)
    turned = states[:, angles]
    return np.hstack([np.delete(states, angles, axis=1), np.cos(turned), np.sin(turned)])
