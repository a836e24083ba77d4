"""The sampling planner: the cross-entropy method with scores of whole matrices."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.evaluation import box_states
from dopt.policies import ICEM
from dopt.randomness import draw
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, information, jacobian, model_step, trace
from tests.dopt.trials import trial

FIELDS = {"lookahead": 5, "hold": 2, "stride": 2, "plans": 7, "iterations": 2, "elites": 3}
FIELDS |= {"samples": 6, "count": 2, "regularization": 0.1}


def score(policy: ICEM, rows: Array, exact: Array) -> float:
    """Return the mean over the horizons of what J W, (n, r, s), is worth; ``exact`` is J M⁻¹ Gᵀ."""
    found = []
    for i in range(1, len(rows) + 1):
        J, V = np.concatenate(rows[:i]), np.concatenate(exact[:i])
        grown = np.eye(len(J)) + J @ J.T
        if policy.criterion == "variance":
            found.append(np.sum(J**2))
        elif policy.criterion == "task":
            found.append(np.trace(V.T @ np.linalg.inv(grown) @ V))
        elif policy.criterion == "sum":
            found.append(sum(np.linalg.slogdet(np.eye(len(j)) + j @ j.T)[1] for j in rows[:i]))
        else:
            found.append(np.linalg.slogdet(grown)[1])
    return float(np.mean(found))


def planned(spec: TrialSpec, run: Trace) -> Array:
    """Return the first inputs of the best plans of all steps but the first, (T - 1, m)."""
    policy, system, draws = spec.policy, spec.system, draw(spec)
    assert isinstance(policy, ICEM)
    H, hold, m, E = policy.lookahead, policy.hold, system.n_inputs, policy.elites
    K, P, gamma, chosen = (H + hold - 1) // hold + 1, policy.plans, system.gamma, []
    states, joint = box_states(system), policy.criterion in ("joint", "task")
    mean, elites, count = np.zeros((K, m)), np.zeros((0, K, m)), policy.task_count
    for t in range(1, system.horizon):
        theta = run.parameters[t]
        U = np.linalg.inv(np.linalg.cholesky(information(spec, run, t, policy.regularization))).T
        at = np.array([states[(t * count + i) % len(states)] for i in range(count)])
        G = jacobian(spec, theta, at.reshape(-1, system.n_states)).reshape(-1, len(U))
        Q, random = np.linalg.qr((G @ U).T)[0], draws.parameters / policy.samples**0.5
        Z = np.concatenate([Q, random - Q @ (Q.T @ random)], axis=1)
        if t % hold == 0:
            mean = np.concatenate([mean[1:], mean[-1:]])
            elites = np.concatenate([elites[:, 1:], elites[:, -1:]], axis=1)
        spread = np.full((K, m), gamma)
        normals = draws.plans[t % len(draws.plans)].reshape(policy.iterations, P, K, m)
        for normal in normals:
            new = mean + spread * normal
            new *= gamma / np.linalg.norm(new, axis=2, keepdims=True)
            tried, values = np.concatenate([elites, new]), []
            for plan in tried:
                path = [run.states[t]]
                for i in range(H // policy.stride * policy.stride):
                    u = plan[(t + i) // hold - t // hold]
                    path.append(model_step(spec, theta, path[-1], u))
                J = jacobian(spec, theta, np.array(path[policy.stride :: policy.stride]))
                J *= policy.stride**0.5 if joint else 1.0
                values.append(score(policy, J @ U @ Z, J @ U @ U.T @ G.T))
            steps = np.rint(np.array(values) / (1e-9 * np.abs(values).max()))
            elites = tried[np.argsort(-steps, kind="stable")[:E]]
            mean = 0.1 * mean + 0.9 * elites.mean(axis=0)
            spread = 0.1 * spread + 0.9 * elites.std(axis=0)
        chosen.append(elites[0, 0])
    return np.array(chosen)


@pytest.mark.parametrize("criterion", ["joint", "sum", "variance", "task"])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_inputs_are_those_of_the_best_sampled_plans(env: str, criterion: str) -> None:
    given, small = FIELDS | {"criterion": criterion}, {"width": 3, "depth": 1}
    spec = trial(env, "icem", 3, env={"horizon": 9}, policy=given, model=small)
    run = trace(spec)
    assert run.inputs[1:] == pytest.approx(planned(spec, run), abs=1e-7 * spec.system.gamma)
