"""Plans of a learner with a noise variance ρ ≠ 1 are judged in the units of M = λI + Σ JᵀJ/ρ."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.kernel.information.primal import dense
from dopt.kernel.run import KernelTrial
from dopt.policies import Search
from dopt.reference import search
from dopt.reference.dynamics import LearnedDynamics
from dopt.reference.exact_gain import ExactGain, Situation
from dopt.reference.information import BatchInformation
from dopt.reference.models import model_function
from dopt.reference.search import paths
from dopt.run import run_trial
from dopt.spec.config import CRITERION_VERSION
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.kernel.test_agreement import check_agreement
from tests.dopt.kernel.twin import transplant
from tests.dopt.torch_models import for_one
from tests.dopt.trials import trial

SEARCHES = ["exact", "trace", "a_optimal", "e_optimal", "task", "lookahead"]


def noisy(
    policy: str, noise_variance: float, name: str = "ekf", horizon: int = 40, **fields: Any
) -> TrialSpec:
    learner = {"name": name, "noise_variance": noise_variance}
    return trial("arm", policy, 2, env={"horizon": horizon}, learner=learner, policy=fields)


def candidate_rows(fast: KernelTrial) -> Array:
    """Return the rows J of each candidate of the next step, by automatic differentiation."""
    policy, system = fast.spec.policy, fast.spec.system
    assert isinstance(policy, Search)
    model = model_function(system, fast.spec.model)
    theta, x = torch.tensor(fast.state.theta), torch.tensor(fast.record.states[fast.done])
    inputs = torch.tensor(policy.compared_inputs(system))
    held = torch.stack([inputs, inputs], 1)
    states = paths(policy, LearnedDynamics(system, model), theta[None], x[None], held)[0, :, 0]
    rows: Array = vmap(jacrev(for_one(model)), (None, 0))(theta, states).numpy()
    return rows


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


def test_the_scores_of_the_reference_are_the_growth_of_the_determinant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = noisy("exact", 0.05)
    fast = KernelTrial(spec)
    fast.advance(12)
    batch, values = transplant_of(spec, spec), []
    monkeypatch.setattr(search, "chosen", lambda value, first, _: values.append(value) or first[:1])
    batch.plan(12)
    C = batch.information.covariance()[0].numpy()
    expected = growth(candidate_rows(fast), C, 0.05)
    assert values[0][0].numpy() == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("learner", ["ekf", "gauss_newton"])
@pytest.mark.parametrize("policy", SEARCHES)
def test_both_paths_judge_alike(policy: str, learner: str) -> None:
    check_agreement(noisy(policy, 0.05, learner, horizon=9))


def test_the_exact_gain_is_that_of_the_matrix() -> None:
    spec = noisy("gradient", 0.05)
    batch = transplant_of(noisy("exact", 0.05), spec)
    assert batch.information is not None
    covariance = batch.information.covariance()
    now = Situation(batch.theta, covariance, batch.states[:, 12], batch.components[:, 12])
    fast = KernelTrial(noisy("exact", 0.05))
    fast.advance(12)
    u = torch.tensor(fast.spec.policy.compared_inputs(spec.system))  # type: ignore[attr-defined]
    C = batch.information.covariance()[0].numpy()
    expected = growth(candidate_rows(fast), C, 0.05)
    found = ExactGain(batch).values(u[None], now)[0].numpy()
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-7)


def transplant_of(run: TrialSpec, other: TrialSpec) -> Any:
    """Return a batch of another policy where a trial of the kernel stands after 12 steps."""
    fast = KernelTrial(run)
    fast.advance(12)
    twin = transplant(fast)
    batch = type(twin)([other])
    batch.theta.copy_(twin.theta)
    batch.states.copy_(twin.states)
    batch.information = BatchInformation(
        torch.linalg.inv(torch.tensor(dense(fast.state.covariance)))[None]
    )
    return batch


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
