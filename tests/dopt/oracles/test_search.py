"""Searching policies: every plan rolled out, and scored by the determinants of whole matrices."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from dopt.evaluation import task_states
from dopt.policies import InformationPolicy, Lookahead, Search, TaskOptimal
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, information, jacobian, model_step, trace
from tests.dopt.trials import trial

CASES: list[tuple[str, dict[str, Any]]] = [
    ("exact", {}),
    ("trace", {}),
    ("a_optimal", {}),
    ("e_optimal", {"subspace": 1000}),
    ("task", {"count": 3}),
    ("lookahead", {"lookahead": 5, "criterion": "joint"}),
    ("lookahead", {"lookahead": 4, "criterion": "sum", "stride": 2}),
]


def worth(spec: TrialSpec, theta: Array, M: Array, rows: Array) -> float:
    """Return what the rows of a path, (n, r, q), are worth beside M."""
    name, J = spec.policy.name, rows.reshape(-1, len(M))
    after = M + J.T @ J
    if name == "trace":
        return float(np.trace(J @ np.linalg.inv(M) @ J.T))
    if name == "a_optimal":
        return -float(np.trace(np.linalg.inv(after)))
    if name == "e_optimal":
        return float(np.linalg.eigvalsh(after)[0])
    if isinstance(spec.policy, TaskOptimal):
        states = task_states(spec.system, spec.policy)
        G = jacobian(spec, theta, states).reshape(-1, len(M))
        return -float(np.trace(G @ np.linalg.inv(after) @ G.T))
    if isinstance(spec.policy, Lookahead) and spec.policy.criterion == "sum":
        return float(sum(np.linalg.slogdet(M + one.T @ one)[1] for one in rows))
    return float(np.linalg.slogdet(after)[1])


def values(spec: TrialSpec, run: Trace, t: int, ridge: float) -> tuple[Array, Array]:
    """Return the first inputs of all plans, (P, m), and what the plans are worth, (P,)."""
    policy, theta, M = spec.policy, run.parameters[t], information(spec, run, t, ridge)
    assert isinstance(policy, Search)
    H = policy.steps(spec.system)
    stride = policy.stride_of(spec.system) if isinstance(policy, Lookahead) else 1
    weight = stride**0.5 if policy.name == "exact" or policy.score == "joint" else 1.0
    candidates, first, found = policy.compared_inputs(spec.system), [], []
    for one, other in itertools.product(candidates, candidates):
        if H == 1 and (one != other).any():
            continue
        path = [run.states[t]]
        for i in range(H):
            path.append(model_step(spec, theta, path[-1], one if i < max(H // 2, 1) else other))
        rows = weight * jacobian(spec, theta, np.array(path[1:])[stride - 1 :: stride])
        first.append(one)
        found.append(worth(spec, theta, M, rows))
    return np.array(first), np.array(found)


@pytest.mark.parametrize(("policy", "fields"), CASES)
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_no_plan_is_better_than_the_chosen_one(env: str, policy: str, fields: Any) -> None:
    given, small = {"candidates": 3, "regularization": 0.1} | fields, {"width": 3, "depth": 1}
    spec = trial(env, policy, 3, env={"horizon": 12}, policy=given, model=small)
    run = trace(spec)
    assert isinstance(spec.policy, InformationPolicy)
    for t in (1, 4, 11):
        first, worths = values(spec, run, t, spec.policy.regularization)
        chosen = worths[(first == run.inputs[t]).all(axis=1)].max()
        assert chosen >= worths.max() - 1e-7 * np.ptp(worths) - 1e-11 * abs(worths.max())
