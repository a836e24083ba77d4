"""Definition 1: the exact gain and its optimum."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.policies.d_optimal import ascend
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, information, jacobian, model_step, trace
from tests.dopt.trials import trial

ENVS = ["pendulum", "cartpole", "arm", "quadrotor"]


def circle(gamma: float, m: int) -> Array:
    angles = np.linspace(0.0, 2 * np.pi, 721)
    two = gamma * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return two if m == 2 else np.array([[gamma], [-gamma]])


@pytest.mark.parametrize("information_of", ["accumulated", "ekf"])
@pytest.mark.parametrize("env", ENVS)
def test_no_input_on_the_sphere_gains_more(env: str, information_of: str) -> None:
    """By log det(M + JᵀJ/ρ) of whole matrices; a filter shares its M with the plan."""
    filters, rho = information_of == "ekf", 0.1 if information_of == "ekf" else 1.0
    learner = {"name": "ekf", "noise_variance": rho} if filters else {"name": "adam"}
    given, small = {"regularization": 0.1}, {"width": 3, "depth": 1}
    spec = trial(env, "gradient", 2, env={"horizon": 8}, policy=given, model=small, learner=learner)
    run = trace(spec)
    for t in (1, 4, 7):
        M, theta = information(spec, run, t, 0.1), run.parameters[t]
        if filters:  # which takes the rows before it learns
            before = run.parameters[:t], run.states[:t]
            rows = [jacobian(spec, p, x[None])[0] for p, x in zip(*before, strict=True)]
            M = 0.1 * np.eye(len(M)) + sum(J.T @ J for J in rows) / rho
        found, *scan = (
            gain(spec, M, theta, run, t, u, rho)
            for u in (run.inputs[t], *circle(spec.system.gamma, spec.system.n_inputs))
        )
        assert np.linalg.norm(run.inputs[t]) == pytest.approx(spec.system.gamma)
        assert found >= max(scan) - 1e-3 * np.ptp(scan)


def gain(spec: object, M: Array, theta: Array, run: Trace, t: int, u: Array, rho: float) -> float:
    """Return log det[M + J(x(u))ᵀ J(x(u))/ρ]."""
    x = model_step(spec, theta, run.states[t], u)  # type: ignore[arg-type]
    J = jacobian(spec, theta, x[None])[0]  # type: ignore[arg-type]
    return float(np.linalg.slogdet(M + J.T @ J / rho)[1])


def test_ascent_ends_at_the_top_axis_of_a_quadratic_form() -> None:
    Q = np.diag([1.0, 2.0, 5.0])
    for start in ([1.0, 1.0, 0.3], [-1.0, 0.2, -0.1]):
        previous = -np.inf
        for iterations in (0, 3, 10, 60):
            given = (np.array(start), 0.5, iterations)
            value, u = ascend(lambda v: (v @ Q @ v, 2.0 * Q @ v), *given)
            assert value >= previous
            assert np.linalg.norm(u) == pytest.approx(np.linalg.norm(start))
            previous = value
        assert value == pytest.approx(5.0 * np.sum(np.square(start)), rel=1e-6)
