"""The D-optimal plan against the gain that it linearises, and against a dense scan."""

from __future__ import annotations

import dataclasses
import functools

import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from dopt.reference.planning import (
    BatchInformation,
    d_optimal_inputs,
    planning_columns,
    quadratic_problem,
)
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.sphere import maximize_on_sphere
from tests.dopt.reference.batch import Situation, situation, sphere, step_from
from tests.dopt.torch_models import for_one
from tests.dopt.trials import PAIRS, trial

CASES = [(env, policy) for env, policy in PAIRS if policy in ("d_optimal", "oracle")]


def gradients(now: Situation, x: Tensor) -> Tensor:
    """Return J = ∂a/∂θ at n states, (n, r, q)."""
    return vmap(jacrev(for_one(now.model)), (None, 0))(now.theta, x)


@functools.cache
def pieces(spec: TrialSpec, seed: int) -> tuple[Tensor, Tensor]:
    """Return J, (r, q), and D B, (r, q, m), at x̄, both of D and B by central differences."""
    system, now = spec.system, situation(spec, seed)
    zero = torch.zeros(system.n_inputs, dtype=torch.float64)
    bar = step_from(spec, now, zero)
    at_bar = now._replace(state=bar)
    B = torch.stack(
        [(step_from(spec, at_bar, e) - step_from(spec, at_bar, -e)) / 2 for e in _axes(zero)], dim=1
    )
    step = 1e-5
    moved = step * _axes(bar)
    D = (gradients(now, bar + moved) - gradients(now, bar - moved)) / (2 * step)
    return gradients(now, bar[None])[0], D.permute(1, 2, 0) @ B


def _axes(like: Tensor) -> Tensor:
    return torch.eye(len(like), dtype=torch.float64)


class Solved(BatchInformation):
    """Matrices, (n, s, s), with which systems of equations are solved as they are."""

    def __init__(self, matrices: Tensor) -> None:
        self._matrices = matrices

    def solve(self, columns: Tensor) -> Tensor:
        return torch.linalg.solve(self._matrices, columns)


def solve(spec: TrialSpec, now: Situation, component: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return Q, v and the chosen input of the reference."""
    given = now.theta[None], now.state[None], torch.tensor([component])
    columns = planning_columns(spec.system, now.model, *given)
    problem = quadratic_problem(columns, Solved(now.information[None]))
    ties = torch.ones(1, spec.system.n_inputs, dtype=torch.float64)
    u = d_optimal_inputs(problem, spec.system.gamma, ties)
    return problem.Q[0], problem.v[0], u[0]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("env", "policy"), CASES)
def test_the_problem_is_made_of_finite_differences_of_the_gradient(
    env: str, policy: str, seed: int
) -> None:
    spec = trial(env, policy)
    now = situation(spec, seed)
    inverse = torch.linalg.inv(now.information)
    for component, (g, DB) in enumerate(zip(*pieces(spec, seed), strict=True)):
        Q, v, _ = solve(spec, now, component)
        # Difference quotients of |v| v and of products lose half of the digits.
        scale = float((DB.mT @ inverse @ DB).abs().max() + (DB.mT @ inverse @ g).abs().max())
        assert torch.allclose(Q, DB.mT @ inverse @ DB, rtol=0.0, atol=1e-6 * scale)
        assert torch.allclose(v, -DB.mT @ inverse @ g, rtol=0.0, atol=1e-6 * scale)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("env", "policy"), CASES)
def test_no_input_on_the_sphere_has_a_larger_linearised_gain(
    env: str, policy: str, seed: int
) -> None:
    spec = trial(env, policy)
    now, gamma = situation(spec, seed), spec.system.gamma
    for component, (g, DB) in enumerate(zip(*pieces(spec, seed), strict=True)):
        columns = torch.column_stack([g, DB])
        form = columns.mT @ torch.linalg.solve(now.information, columns)

        def gain(u: Tensor, form: Tensor = form) -> Tensor:
            """Return rowᵀ M⁻¹ row for the row g + D B u, of each of the inputs."""
            weights = torch.cat([torch.ones(len(u), 1, dtype=torch.float64), u], dim=1)
            return ((weights @ form) * weights).sum(-1)

        u = solve(spec, now, component)[2]
        scan = sphere(gamma, spec.system.n_inputs)
        assert u.norm().item() == pytest.approx(gamma, rel=1e-12)
        assert gain(u[None]) >= gain(scan).max() - 1e-7 * gain(u[None]).abs()


def test_the_linearised_gain_is_the_gain_to_first_order_in_the_step() -> None:
    """Proposition 1: the difference falls with dt², while what the input changes falls with dt."""
    for env in ("pendulum", "cartpole", "arm", "quadrotor"):
        errors, effects = zip(*(_gap_and_effect(env, dt) for dt in (4e-3, 2e-3, 1e-3)), strict=True)
        for coarse, fine in ((0, 1), (1, 2)):
            assert errors[coarse] / errors[fine] == pytest.approx(4.0, rel=0.15), env
            assert effects[coarse] / effects[fine] == pytest.approx(2.0, rel=0.1), env
        assert errors[2] < 0.1 * effects[2]


def _gap_and_effect(env: str, dt: float) -> tuple[float, float]:
    """Return |exact - linearised| gain of one component, and how much the input changes it."""
    spec = trial(env, "d_optimal")
    system = dataclasses.replace(spec.system, dt=dt)
    spec = TrialSpec(TrialConfig(system, spec.policy, spec.model, spec.learner))
    now, component = situation(spec, 6), system.n_learned - 1
    J, DBs = pieces(spec, 6)
    g, DB = J[component], DBs[component]
    u = torch.full((system.n_inputs,), system.gamma / system.n_inputs**0.5, dtype=torch.float64)

    def logdet(row: Tensor) -> float:
        return float(torch.logdet(now.information + torch.outer(row, row)))

    exact, opposite = (
        logdet(gradients(now, step_from(spec, now, sign * u)[None])[0, component])
        for sign in (1, -1)
    )
    return abs(exact - logdet(g + DB @ u)), abs(exact - opposite)


def test_each_trial_of_a_batch_has_its_own_problem() -> None:
    spec = trial("arm", "d_optimal")
    several = [situation(spec, seed) for seed in range(3)]
    theta, x = (torch.stack([now[i] for now in several]) for i in (1, 2))
    columns = planning_columns(spec.system, several[0].model, theta, x, torch.tensor([0, 1, 1]))
    information = Solved(torch.stack([now.information for now in several]))
    problem = quadratic_problem(columns, information)
    ties = torch.ones(3, 2, dtype=torch.float64)
    inputs = d_optimal_inputs(problem, spec.system.gamma, ties)
    for i, component in enumerate((0, 1, 1)):
        Q, v, u = solve(spec, several[i], component)
        assert torch.allclose(problem.Q[i], Q, rtol=1e-12)
        assert torch.allclose(problem.v[i], v, rtol=1e-12)
        expected = maximize_on_sphere(Q.numpy(), v.numpy(), spec.system.gamma, ties[i].numpy())
        assert inputs[i].numpy() == pytest.approx(expected, rel=1e-9)
        assert u.numpy() == pytest.approx(expected)
