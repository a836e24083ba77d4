"""Plans of a learner with a noise variance ρ ≠ 1 are judged in the units of M = λI + Σ JᵀJ/ρ."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.policies import Search
from dopt.run import run_trial
from dopt.spec.config import CRITERION_VERSION
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import jacobian, model_step
from tests.dopt.trials import trial

SEARCHES = ["exact", "trace", "a_optimal", "e_optimal", "task", "lookahead"]


def noisy(
    policy: str, noise_variance: float, name: str = "ekf", horizon: int = 40, **fields: Any
) -> TrialSpec:
    learner = {"name": name, "noise_variance": noise_variance}
    return trial("arm", policy, 2, env={"horizon": horizon}, learner=learner, policy=fields)


def candidate_rows(fast: KernelTrial) -> Array:
    """Return the rows J of each candidate of the next step."""
    policy, system = fast.spec.policy, fast.spec.system
    assert isinstance(policy, Search)
    theta, x = fast.state.theta, fast.record.states[fast.done]
    states = [model_step(fast.spec, theta, x, u) for u in policy.compared_inputs(system)]
    return jacobian(fast.spec, theta, np.array(states))


def growth(J: Array, C: Array, noise_variance: float) -> Array:
    """Return log det(M + JᵀJ/ρ) - log det M for the rows of each candidate, given C = M⁻¹."""
    values: Array = np.linalg.slogdet(np.eye(J.shape[1]) + J @ C @ J.mT / noise_variance)[1]
    return values


def decrease(J: Array, C: Array, noise_variance: float) -> Array:
    """Return tr M⁻¹ - tr (M + JᵀJ/ρ)⁻¹ for the rows of each candidate, given C = M⁻¹."""
    CJ = C @ J.mT
    removed = CJ @ np.linalg.solve(noise_variance * np.eye(J.shape[1]) + J @ CJ, CJ.mT)
    traces: Array = np.trace(removed, axis1=1, axis2=2)
    return traces


def test_the_measures_are_those_of_the_whole_matrix() -> None:
    rng = np.random.default_rng(0)
    J, root = rng.normal(size=(3, 2, 7)), rng.normal(size=(7, 7))
    M = np.eye(7) + root @ root.T
    C = np.linalg.inv(M)
    for noise_variance in (0.01, 30.0):
        after = M + J.mT @ J / noise_variance
        logs = np.linalg.slogdet(after)[1] - np.linalg.slogdet(M)[1]
        traces = np.trace(C) - np.trace(np.linalg.inv(after), axis1=1, axis2=2)
        assert growth(J, C, noise_variance) == pytest.approx(logs, rel=1e-9)
        assert decrease(J, C, noise_variance) == pytest.approx(traces, rel=1e-9)


MEASURES = {"exact": growth, "a_optimal": decrease}


@pytest.mark.parametrize("noise_variance", [0.01, 0.1, 30.0])
@pytest.mark.parametrize("policy", MEASURES)
def test_the_input_is_the_best_for_the_matrix_itself(policy: str, noise_variance: float) -> None:
    fast, judged_otherwise = KernelTrial(noisy(policy, noise_variance)), 0
    assert isinstance(fast.spec.policy, Search)
    candidates = fast.spec.policy.compared_inputs(fast.spec.system)
    for t in range(2, 40):
        fast.advance(t)
        J, C = candidate_rows(fast), dense(fast.state.covariance)
        found, unscaled = (MEASURES[policy](J, C, rho) for rho in (noise_variance, 1.0))
        fast.advance(t + 1)
        taken = int(np.flatnonzero((candidates == fast.record.inputs[t]).all(axis=1))[0])
        assert found[taken] >= found.max() - 1e-6 * abs(found.max())
        judged_otherwise += unscaled[taken] < unscaled.max() * (1 - 1e-6)
    if policy != "exact":  # whose best candidate seldom depends on ρ
        assert judged_otherwise > 0


@pytest.mark.parametrize("policy", [*SEARCHES, "gradient"])
def test_such_trials_have_new_keys_and_no_others(policy: str) -> None:
    new, old = noisy(policy, 0.5), noisy(policy, 1.0)
    assert json.loads(new.config_json)["criterion_version"] == CRITERION_VERSION
    assert "criterion_version" not in old.config_json
    assert TrialSpec.from_mapping(new.to_mapping()) == new
    for other in ("d_optimal", "trace_linearized", "random"):
        assert "criterion_version" not in noisy(other, 0.5).config_json


def test_the_trace_is_judged_as_before() -> None:
    """Its argument is linear in 1/ρ; a power of four is divided by exactly."""
    for noise_variance in (0.25, 4.0):
        spec = noisy("trace", noise_variance)
        fast = KernelTrial(spec)
        unscaled = fast.trial.algorithm.search._replace(row_scale=1.0)
        fast.trial = fast.trial._replace(algorithm=fast.trial.algorithm._replace(search=unscaled))
        fast.advance(spec.system.horizon)
        assert np.array_equal(fast.record.inputs, run_trial(spec).inputs)
