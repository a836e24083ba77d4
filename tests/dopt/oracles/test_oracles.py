"""Steps of the kernel against dense matrices, searched plans and sums over whole trials."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from dopt.evaluation import box_states, task_states
from dopt.kernel.run import KernelTrial
from dopt.learning import GaussNewton, JointKalman
from dopt.models import MLP, Ensemble, GaussianProcess
from dopt.policies import (
    ICEM,
    GaussianProcessEntropy,
    InformationPolicy,
    Lookahead,
    Search,
    TaskOptimal,
)
from dopt.policies.base import on_sphere
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import (
    STEP,
    Trace,
    accelerations,
    following,
    information,
    jacobian,
    model_step,
    observed,
    trace,
)
from tests.dopt.trials import trial

# The two policies of the paper that plan: every input of the sphere is tried


def of_the_sphere(spec: TrialSpec) -> Array:
    """Return inputs of norm γ, (N, m): both there are, or many in random directions."""
    m = spec.system.n_inputs
    drawn = np.random.default_rng(0).standard_normal((2000, m)) if m > 1 else [[1.0], [-1.0]]
    return on_sphere(np.array(drawn), spec.system.gamma)


@pytest.mark.parametrize("policy", ["d_optimal", "oracle"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_no_input_has_a_larger_linearised_gain(env: str, policy: str) -> None:
    """Of uᵀQu - 2vᵀu, Q = (DB)ᵀM⁻¹DB and v = -(DB)ᵀM⁻¹g, with D and B by central differences."""
    small: dict[str, Any] = {"model": {"width": 3}} if policy == "d_optimal" else {}
    spec = trial(env, policy, 3, env={"horizon": 10}, policy={"regularization": 0.1}, **small)
    run, inputs, m = trace(spec), of_the_sphere(spec), spec.system.n_inputs
    for t in (1, 4, 9):
        theta, component = run.parameters[t], draw(spec).components[t]
        bar = model_step(spec, theta, run.states[t], np.zeros(m))
        ends = [[model_step(spec, theta, bar, s * e) for e in np.eye(m)] for s in (1, -1)]
        moves = 1e-5 * (np.array(ends[0]) - ends[1]) / 2
        ahead, behind = (jacobian(spec, theta, bar + s * moves)[:, component] for s in (1, -1))
        DB, g = (ahead - behind).T / 2e-5, jacobian(spec, theta, bar[None])[0, component]
        solved = np.linalg.solve(information(spec, run, t, 0.1), np.column_stack([DB, g]))
        Q, v = DB.T @ solved[:, :m], -DB.T @ solved[:, m]
        tried = np.concatenate([run.inputs[t : t + 1], inputs])
        chosen, *others = np.einsum("ni,ij,nj->n", tried, Q, tried) - 2 * tried @ v
        assert chosen >= max(others) - 1e-6 * np.ptp(others)


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_no_input_of_the_uniform_policy_leads_farther(env: str) -> None:
    """From all states seen; an ascent may lose a little of the whole range."""
    spec = trial(env, "uniform", 2, env={"horizon": 20}, model={"width": 3})
    run, inputs = trace(spec), of_the_sphere(spec)[:200]
    for t in (1, 7, 19):
        ends = [
            model_step(spec, run.parameters[t], run.states[t], u) for u in (run.inputs[t], *inputs)
        ]
        apart = np.linalg.norm(np.array(ends)[:, None] - run.states[None, : t + 1], axis=-1)
        chosen, *others = apart.sum(axis=1)
        margin = 1e-12 * chosen if spec.system.n_inputs == 1 else 1e-3 * np.ptp(others)
        assert chosen >= max(others) - margin


# Searching policies: every plan rolled out, and scored by the determinants of whole matrices.


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


# The sampling planner: the cross-entropy method with scores of whole matrices.


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


# The Gaussian process: mean and entropy from the covariance matrix of all samples at once.


class Conditioned:
    """The process given all samples of a trial before a step."""

    def __init__(self, spec: TrialSpec, run: Trace, t: int) -> None:
        assert isinstance(spec.model, GaussianProcess)
        self._spec, self._model = spec, spec.model
        self._seen = spec.system.featurize(run.states[:t])
        self._noise = max(spec.system.noise**2 / spec.system.dt, 1e-10 * self._model.amplitude**2)
        K = self.kernel(self._seen, self._seen) + self._noise * np.eye(t)
        self._inverse = np.linalg.inv(K)
        self.weights = self._inverse @ observed(spec, run)[:t]

    def kernel(self, a: Array, b: Array) -> Array:
        squares = ((a[:, None] - b[None]) ** 2).sum(axis=2)
        found: Array = self._model.amplitude**2 * np.exp(-squares / 2 / self._model.lengthscale**2)
        return found

    def mean(self, x: Array) -> Array:
        """Return the posterior mean, (r,), at a state."""
        found: Array = self.kernel(self._spec.system.featurize(x[None]), self._seen) @ self.weights
        return found[0]

    def entropy(self, path: Array) -> float:
        """Return log det of the covariance of what would be observed on a path, (H, d)."""
        phi = self._spec.system.featurize(path)
        cross = self.kernel(phi, self._seen)
        S = self.kernel(phi, phi) - cross @ self._inverse @ cross.T
        return float(np.linalg.slogdet(S + self._noise * np.eye(len(path)))[1])


@pytest.mark.parametrize(("env", "lookahead"), [("pendulum", 1), ("arm", 3)])
def test_the_entropy_of_no_candidate_is_larger(env: str, lookahead: int) -> None:
    policy = {"lookahead": lookahead, "candidates": 5}
    spec = trial(env, "gaussian_process", 3, env={"horizon": 14}, policy=policy)
    run = trace(spec)
    assert isinstance(spec.policy, GaussianProcessEntropy)
    candidates = spec.policy.compared_inputs(spec.system)
    for t in (1, 5, 13):
        process, values = Conditioned(spec, run, t), []
        alpha = spec.system.horizon * len(spec.system.features)
        weights = run.parameters[t][alpha:].reshape(-1, spec.system.horizon).T
        size = np.abs(process.weights).max()
        assert weights[:t] == pytest.approx(process.weights, abs=1e-7 * size)
        for u in candidates:
            path = [run.states[t]]
            for _ in range(lookahead):
                path.append(following(spec, path[-1], u, process.mean(path[-1])))
            values.append(process.entropy(np.array(path[1:])))
        chosen = np.flatnonzero((candidates == run.inputs[t]).all(axis=1))
        assert values[chosen[0]] >= max(values) - 1e-6 * np.ptp(values)


# Ensembles: members that take turns with damped Gauss-Newton fits of all samples.


def fitted(spec: TrialSpec, run: Trace, t: int, theta: Array, prior: Array) -> Array:
    """Return the parameters of one network after its fits of the samples up to step t."""
    learner, network = spec.learner, MLP(width=spec.model.width, depth=spec.model.depth)  # type: ignore[attr-defined]  # an ensemble
    assert isinstance(learner, GaussNewton)
    states = run.states[: t + 1][-learner.capacity :]
    targets = observed(spec, run)[: t + 1][-learner.capacity :]
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


# Low-pass filters of measured states: sums over all outputs, weighted by their age.


def low_passed(values: Array, start: Array, share: float) -> Array:
    """Return Σ_k s (1 - s)^(t - k) y_k after each of n values, (n, k), and a start, (k,)."""
    n = len(values)
    ages = np.arange(n)[:, None] - np.arange(n)[None]
    weights = np.where(ages >= 0, share * (1.0 - share) ** np.maximum(ages, 0), 0.0)
    begun: Array = (1.0 - share) ** np.arange(1, n + 1)
    filtered: Array = weights @ values + begun[:, None] * start
    return filtered


@pytest.mark.parametrize(
    ("env", "measured", "rates"), [("pendulum", [0], [1]), ("arm", [0, 2], [1, 3])]
)
def test_estimates_are_weighted_sums_of_what_was_measured(
    env: str, measured: list[int], rates: list[int]
) -> None:
    """Differences come one step late by the Euler map: positions and inputs wait for them."""
    noise = [1e-3] * len(measured)
    fields = {"horizon": 25, "measured_states": measured, "measurement_noise": noise}
    spec = trial(env, "random", 4, env=fields)
    run, system = KernelTrial(spec), spec.system
    run.advance(system.horizon)
    record, share = run.record, 1.0 - np.exp(-2.0 * np.pi * system.velocity_cutoff * system.dt)
    truth, start = record.true_states, np.array(system.initial_state)
    y = truth[1:, measured] + draw(spec).measurement_noise
    before = np.concatenate([start[None, measured], y[:-1]])
    positions = low_passed(y, start[measured], share)
    earlier = np.concatenate([start[None, measured], positions[:-1]])
    velocities = low_passed((y - before) / system.dt, start[rates], share)
    assert record.states[1:, measured] == pytest.approx(earlier, abs=1e-12)
    assert record.states[1:, rates] == pytest.approx(velocities, rel=1e-9, abs=1e-10)
    inputs = low_passed(record.inputs, np.zeros(system.n_inputs), share)
    late = np.concatenate([np.zeros((1, system.n_inputs)), inputs[:-1]])
    assert run.state.estimate.inputs == pytest.approx(late, abs=1e-12)


# The filter over state and parameters: one covariance matrix of both, in one piece.


def filtered(spec: TrialSpec, outputs: Array, inputs: Array) -> tuple[Array, Array, Array]:
    """Return states, (T + 1, d), parameters, (T + 1, q), and the last variances, without fits."""
    system, learner, C = spec.system, spec.learner, spec.system.output_rows
    assert isinstance(learner, JointKalman)
    theta, d, dt = draw(spec).weights, system.n_states, system.dt
    q, rho, zeta = len(theta), learner.noise_variance, learner.underweighting
    E = np.zeros((d, system.n_learned))
    E[list(system.learned_rows), range(system.n_learned)] = 1.0
    covariance = np.zeros((d + q, d + q))
    covariance[d:, d:] = np.eye(q) / learner.regularization
    z, states, parameters = np.concatenate([system.initial_state, theta]), [], []
    for y, u in zip(outputs, inputs, strict=True):
        states.append(z[:d])
        parameters.append(z[d:])
        x, theta = z[:d], z[d:]
        J = jacobian(spec, theta, x[None])[0]
        F = np.eye(d + q)
        F[:d, d:] = dt * E @ J
        for j in range(d):
            step = 1e-5 * max(1.0, abs(x[j])) * np.eye(d)[j]
            ends = [model_step(spec, theta, x + sign * step, u) for sign in (1, -1)]
            F[:d, j] = (ends[0] - ends[1]) / (2 * step[j])
        R = rho * np.eye(len(J)) + zeta * J @ covariance[d:, d:] @ J.T
        covariance = F @ covariance @ F.T
        covariance[:d, :d] += dt**2 * E @ R @ E.T
        z = np.concatenate([model_step(spec, theta, x, u), theta])
        H = np.concatenate([C, np.zeros((len(C), q))], axis=1)
        S = H @ covariance @ H.T + np.diag(np.array(system.measurement_noise) ** 2)
        gain = covariance @ H.T @ np.linalg.inv(S)
        z = z + gain @ (y - H @ z)
        covariance = covariance - gain @ S @ gain.T
    return np.array([*states, z[:d]]), np.array([*parameters, z[d:]]), np.diag(covariance)


@pytest.mark.parametrize(
    "fields",
    [
        {"measured_states": [0], "measurement_noise": [1e-2]},
        {"measured_states": [0, 2], "measurement_noise": [1e-2, 2e-2]},
        {
            "output_matrix": [1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            "measurement_noise": [1e-2, 1e-2],
        },
    ],
)
@pytest.mark.parametrize("underweighting", [0.0, 0.3])
def test_it_is_the_filter_over_both_at_once(
    fields: dict[str, object], underweighting: float
) -> None:
    learner = {"name": "joint_ekf", "noise_variance": 0.1, "regularization": 2.0}
    learner |= {"refit_every": 1000, "underweighting": underweighting}
    env, small = {"horizon": 15} | fields, {"width": 3, "depth": 1}
    spec = trial("arm", "random", 4, env=env, model=small, learner=learner)
    run = KernelTrial(spec)
    run.advance(15)
    outputs = run.record.true_states[1:] @ spec.system.output_rows.T + draw(spec).measurement_noise
    states, parameters, _ = filtered(spec, outputs, run.record.inputs)
    assert run.record.states == pytest.approx(states, abs=1e-7)
    assert run.parameters == pytest.approx(parameters[-1], abs=1e-7)


# Limits: all paths of all inputs, errors and backup inputs, one after the other.


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
    seen, scale = observed(spec, run), np.zeros(spec.system.n_learned)
    for s in range(t):
        value = accelerations(spec, run.parameters[s], run.states[s], run.inputs[s])
        scale += max(1 / (s + 1), 1 / 25) * ((seen[s] - value) ** 2 - scale)
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
