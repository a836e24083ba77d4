"""Limits: all paths of all inputs, errors and backup inputs, one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, accelerations, following, observed, trace
from tests.dopt.trials import trial


class Bounds:
    """Limits of a trial, and what the errors of its model have been."""

    def __init__(self, spec: TrialSpec) -> None:
        limits, system = spec.config.limits, spec.system
        assert limits is not None
        self.spec, self.steps, self.margin = spec, limits.steps, limits.margin
        self.states, self.inputs = limits.of_states(system).T, limits.of_inputs(system).T
        self.changes = limits.changes(system)
        axes = system.gamma * np.eye(system.n_inputs)
        signed = [sign * axis for axis in axes for sign in (1, -1)]
        self.backups = [*signed, np.zeros(system.n_inputs)]

    def moved(self, before: Array, u: Array) -> Array:
        """Return an input within its box, as near to it as the rates let it come."""
        u = np.clip(u, *self.inputs)
        change = np.maximum(np.abs(u - before), 1e-300)
        within: Array = before + min(1.0, np.min(self.changes / change)) * (u - before)
        return within

    def excess(self, theta: Array, x: Array, u: Array, errors: Array) -> float:
        """Return how far an input leads beyond the bounds: worst error, best backup."""
        r, worst = len(errors), []
        cases = [
            np.zeros(r),
            *[s * e * np.eye(r)[k] for k, e in enumerate(errors) for s in (1, -1)],
        ]
        for off in cases:
            found = []
            for backup in self.backups:
                state, v, beyond = x, u, []
                for step in range(self.steps):
                    v = self.moved(v, backup) if step else v
                    learned = accelerations(self.spec, theta, state, v) + off
                    state = following(self.spec, state, v, learned)
                    beyond.append(np.max([self.states[0] - state, state - self.states[1]]))
                found.append(max(beyond))
            worst.append(min(found))
        return max(worst)


def allowed(bounds: Bounds, run: Trace, planned: Array, t: int) -> Array:
    """Return the input of step t in the place of a planned one, (m,), without information."""
    spec = bounds.spec
    before = run.inputs[t - 1] if t else np.zeros(spec.system.n_inputs)
    scale = np.zeros(spec.system.n_learned)
    for s in range(t):
        value = accelerations(spec, run.parameters[s], run.states[s], run.inputs[s])
        scale += max(1 / (s + 1), 1 / 25) * ((observed(spec, run, s) - value) ** 2 - scale)
    tried = [bounds.moved(before, u) for u in (planned, -planned, *bounds.backups)]
    errors = bounds.margin * np.sqrt(scale)
    found = [bounds.excess(run.parameters[t], run.states[t], u, errors) for u in tried]
    kept = [u for u, excess in zip(tried, found, strict=True) if excess <= 0.0]
    return kept[0] if kept else tried[int(np.argmin(found))]


@pytest.mark.parametrize(
    ("env", "limits"),
    [
        ("pendulum", {"bounds": {"φ": [-0.05, 0.05]}, "steps": 6}),
        ("arm", {"bounds": {"φ₁": [-0.1, 0.1]}, "rates": {"u₁": 90.0}, "steps": 3}),
    ],
)
def test_the_first_input_that_keeps_the_states_within_bounds_is_taken(
    env: str, limits: Any
) -> None:
    unlimited = trial(env, "random", 4, env={"horizon": 25}, model={"width": 3})
    spec = TrialSpec.from_mapping(unlimited.to_mapping() | {"limits": limits})
    free = run_trial(unlimited).inputs
    run, bounds = trace(spec), Bounds(spec)
    expected = [allowed(bounds, run, free[t], t) for t in range(25)]
    assert run.inputs == pytest.approx(np.array(expected), abs=1e-9)
    assert not np.allclose(run.inputs, free)
