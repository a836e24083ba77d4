"""Ensembles: members that take turns with damped Gauss-Newton fits of all samples."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.learning import GaussNewton
from dopt.models import MLP, Ensemble
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, observed, trace
from tests.dopt.trials import trial

STEP = 1e-30


def fitted(spec: TrialSpec, run: Trace, t: int, theta: Array, prior: Array) -> Array:
    """Return the parameters of one network after its fits of the samples up to step t."""
    learner, network = spec.learner, MLP(width=spec.model.width, depth=spec.model.depth)  # type: ignore[attr-defined]  # an ensemble
    assert isinstance(learner, GaussNewton)
    states = run.states[: t + 1][-learner.capacity :]
    targets = np.array([observed(spec, run, s) for s in range(t + 1)])[-learner.capacity :]
    ridge = learner.regularization * learner.noise_variance

    def errors(at: Array) -> Array:
        whole: Array = (targets - network.predict_at(spec.system, at, states)).ravel()
        return whole

    def objective(at: Array) -> float:
        return float(np.sum(errors(at) ** 2) + ridge * np.sum((at - prior) ** 2))

    for _ in range(learner.steps):
        moved = theta + 1j * STEP * np.eye(len(theta))
        J = -np.array([errors(one).imag / STEP for one in moved]).T
        right = J.T @ errors(theta) + ridge * (prior - theta)
        step = np.linalg.solve(J.T @ J + ridge * np.eye(len(theta)), right)
        share = 1.0
        while share > 1 / 128 and objective(theta + share * step) > objective(theta) * (1 + 1e-10):
            share /= 2
        theta = theta + share * step if share > 1 / 128 else theta
    return theta


@pytest.mark.parametrize("fields", [{}, {"capacity": 4, "steps": 2, "noise_variance": 0.1}])
def test_members_take_turns(fields: dict[str, float]) -> None:
    """At step t the first one and another one fit; the others stay as they are."""
    learner = {"name": "gauss_newton", "regularization": 0.1} | fields
    model = {"name": "ensemble", "members": 3, "width": 3, "depth": 1}
    spec = trial("pendulum", "random", 2, env={"horizon": 12}, model=model, learner=learner)
    run = trace(spec)
    assert isinstance(spec.model, Ensemble)
    members = run.parameters.reshape(len(run.parameters), spec.model.members, -1)
    for t in range(spec.system.horizon):
        expected = members[t].copy()
        for turn in (1 + t % 2, 0):
            expected[turn] = fitted(spec, run, t, members[t, turn], members[0, turn])
        size = np.abs(expected).max()
        assert members[t + 1] == pytest.approx(expected, abs=1e-7 * size)
