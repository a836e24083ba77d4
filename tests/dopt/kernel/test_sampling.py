"""The sampling planner: the kernel against the reference, and both against their definition."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.run import KernelTrial
from dopt.kernel.search.sampling import domain_weight
from dopt.policies import ICEM
from dopt.policies.task_states import box_states, domain_box
from dopt.reference.batch import Lockstep
from dopt.reference.sampling import SampledPlan, _domain_weights
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from dopt.types import Array
from tests.dopt.kernel.calls import interpreted
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.torch_models import for_one
from tests.dopt.trials import trial

SMALL = {"lookahead": 7, "hold": 3, "stride": 2, "plans": 9, "iterations": 2, "elites": 3}
GAUSS_NEWTON = {"name": "gauss_newton"}
STEPS = 16
"""More than twice the steps of a plan: its first input is held to its end five times."""


def spec_of(
    env: str,
    criterion: str = "joint",
    learner: dict[str, Any] | None = None,
    horizon: int = STEPS,
    **fields: Any,
) -> TrialSpec:
    given = SMALL | {"criterion": criterion, "samples": 6, "count": 3} | fields
    size = {"env": {"horizon": horizon}, "model": {"width": 8}}
    return trial(env, "icem", 3, policy=given, learner=learner or {}, **size)


@pytest.mark.parametrize("criterion", ["joint", "sum", "variance", "task"])
@pytest.mark.parametrize("env", ["pendulum", "arm", "quadrotor"])
def test_kernel_and_reference_choose_the_same_plans(env: str, criterion: str) -> None:
    spec = spec_of(env, criterion)
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-7
    assert relative_gap(fast.states, plain.states) < 1e-8
    assert len(np.unique(fast.inputs[1:].round(9), axis=0)) > 1 or spec.system.n_inputs == 1


@pytest.mark.parametrize(
    ("criterion", "learner"),
    [
        ("joint", GAUSS_NEWTON),
        ("task", GAUSS_NEWTON | {"noise_variance": 0.1}),
        ("task", GAUSS_NEWTON | {"noise_variance": 0.1, "refit_every": 3}),
        ("joint", {"name": "ekf", "noise_variance": 0.5}),
    ],
)
def test_they_agree_beside_a_learner_that_shares_the_matrix(
    criterion: str, learner: dict[str, Any]
) -> None:
    """It leaves the factor of M where it fits all samples at each step, and M⁻¹ otherwise."""
    spec = spec_of("cartpole", criterion, learner, domain="box")
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-6
    assert relative_gap(fast.states, plain.states) < 1e-6


def test_with_a_model_that_is_linear_in_its_parameters_they_agree() -> None:
    spec = TrialSpec.from_mapping(
        {
            "env": {"name": "arm", "horizon": 20, "grid_points": [2, 2, 2, 2]},
            "policy": {"name": "icem", **SMALL, "criterion": "task", "count": 3},
            "model": {"name": "linear"},
            "learner": {"name": "recursive_least_squares"},
            "seed": 1,
        }
    )
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-7


def planned(spec: TrialSpec, steps: int) -> tuple[Lockstep, SampledPlan]:
    """Return a batch of one trial on the reference after some steps, and its plan."""
    batch = Lockstep([spec])
    for t in range(steps):
        batch.step(t)
    assert isinstance(batch.own_plan, SampledPlan)
    return batch, batch.own_plan


def rows_at(batch: Lockstep, states: Array) -> torch.Tensor:
    """Return J at states, (N, d), as a matrix, (N r, q)."""
    rows = vmap(jacrev(for_one(batch.model)), (None, 0))(batch.theta[0], torch.tensor(states))
    return rows.flatten(0, 1).detach()


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_products_with_the_rows_at_task_states_are_exact_and_all_others_unbiased(env: str) -> None:
    batch, plan = planned(spec_of(env, "task", samples=4000), 12)
    assert batch.information is not None
    W, R = (part[0] for part in plan._directions(12))
    states = box_states(batch.system)
    task, other = rows_at(batch, states[36:39]), rows_at(batch, states[500:510])
    M = batch.information.matrix()[0]
    exact = task @ torch.linalg.solve(M, other.mT)
    through_basis = R.mT @ (other @ W[:, : len(R)]).mT
    assert relative_gap(through_basis.numpy(), exact.numpy()) < 1e-8
    covariance = other @ torch.linalg.solve(M, other.mT)
    gap = relative_gap(((other @ W) @ (other @ W).mT).numpy(), covariance.numpy())
    assert gap < 5 * (2 / 4000) ** 0.5


@pytest.mark.parametrize("criterion", ["joint", "sum", "variance", "task"])
def test_scores_are_those_of_dense_matrices(criterion: str) -> None:
    """As many exact directions as parameters leave nothing to chance."""
    spec = spec_of("arm", criterion, samples=20_000)
    batch, plan = planned(spec, 4)
    assert batch.information is not None
    inputs = plan._elites
    values = plan._values(4, inputs, *plan._directions(4))[0]
    states = plan._paths(4, inputs)[0][0]
    M, r = batch.information.matrix()[0], batch.system.n_learned
    G = rows_at(batch, box_states(batch.system)[12:15])
    for path, value in zip(states, values, strict=True):
        J = rows_at(batch, path.numpy()) * (2**0.5 if criterion in ("joint", "task") else 1.0)
        expected = [dense_score(criterion, M, J[: r * (i + 1)], G, r) for i in range(len(path))]
        assert float(value) == pytest.approx(np.mean(expected), rel=0.05)


def dense_score(criterion: str, M: torch.Tensor, J: torch.Tensor, G: torch.Tensor, r: int) -> float:
    """Return the score of a path with the rows J, of which each state has r."""
    S = J @ torch.linalg.solve(M, J.mT)
    if criterion == "joint":
        return float(torch.logdet(torch.eye(len(S)) + S))
    if criterion == "variance":
        return float(S.trace())
    if criterion == "task":
        after = torch.linalg.inv(M + J.mT @ J)
        return float((G @ (torch.linalg.inv(M) - after) @ G.mT).trace())
    blocks = [S[i : i + r, i : i + r] for i in range(0, len(S), r)]
    return float(sum(torch.logdet(torch.eye(r) + block) for block in blocks))


@pytest.mark.parametrize("path", ["kernel", "reference"])
def test_outside_of_the_domain_rows_count_less(path: str) -> None:
    """Beside a box that is never left nothing changes, and one that is does make a difference."""
    inputs = {}
    for name, half_widths in (("wide", (7.0, 1e6)), ("narrow", (0.02, 0.02))):
        for domain in ("everywhere", "box"):
            fields = SMALL | {"domain": domain, "lookahead": 12, "stride": 6}
            env = {"grid_half_widths": half_widths, "horizon": 14}
            spec = trial("pendulum", "icem", 3, env=env, policy=fields)
            inputs[name, domain] = run_trial(spec, path).inputs
    assert np.array_equal(inputs["wide", "box"], inputs["wide", "everywhere"])
    assert not np.array_equal(inputs["narrow", "box"], inputs["narrow", "everywhere"])


def test_the_weight_of_a_state_falls_with_its_distance_from_the_box_on_the_circle() -> None:
    system = SYSTEMS["arm"]()
    domain = torch.tensor(domain_box(system, "box"))
    half = torch.tensor(system.grid_half_widths, dtype=torch.float64)
    assert float(_domain_weights(domain, half)) == 1.0
    assert float(_domain_weights(domain, half * torch.tensor([1.25, 1.0, 1.0, 1.0]))) == (
        pytest.approx(math.exp(-0.5))
    )
    turned = half + torch.tensor([2 * math.pi, 0.0, -2 * math.pi, 0.0])
    assert float(_domain_weights(domain, turned)) == pytest.approx(1.0)
    weight = interpreted(domain_weight)
    for x in torch.randn(20, 4, dtype=torch.float64) * 2:
        assert weight(domain.numpy(), x.numpy()) == pytest.approx(
            float(_domain_weights(domain, x)), rel=1e-12
        )


def test_the_first_input_is_that_of_the_best_plan_and_all_have_the_norm_gamma() -> None:
    _, plan = planned(spec_of("arm"), 10)
    u = plan.plan(10)
    values = plan._values(10, plan._elites, *plan._directions(10))
    assert torch.equal(u, plan._elites[:, values.argmax(), 0])
    assert (torch.linalg.vector_norm(plan._elites, dim=-1) - 5.0).abs().max() < 1e-12


def test_more_iterations_find_better_plans() -> None:
    """Over the steps of a trial, whose states differ little: the sum of the scores grows."""
    found = []
    for iterations in (1, 4):
        fields = {"lookahead": 24, "stride": 4, "iterations": iterations, "horizon": 30}
        batch, plan = planned(spec_of("arm", **fields), 2)
        batch.states[:, 2] = torch.tensor([[0.1, 0.2, -0.1, 0.1]])
        plan.plan(2)
        found.append(float(plan._values(2, plan._elites, *plan._directions(2)).max()))
    assert found[1] > found[0]


def test_plans_are_shifted_when_their_first_input_has_been_held_to_its_end() -> None:
    batch, plan = planned(spec_of("pendulum"), 8)
    plan.plan(8)
    before = plan._elites.clone()
    batch.step(8)
    fast = KernelTrial(batch.specs[0])
    fast.advance(9)
    policy = batch.config.policy
    assert isinstance(policy, ICEM)
    memory = fast.state.policy_memory.reshape(1 + policy.elites, policy.segments, 1)
    assert np.allclose(memory[1:], plan._elites[0].numpy(), atol=1e-9)
    plan._normals.zero_()  # every plan drawn is the mean
    plan.plan(9)
    kept = {tuple(row) for row in plan._elites[0, :, :-1, 0].sign().tolist()}
    assert kept & {tuple(row) for row in before[0, :, 1:, 0].sign().tolist()}


def test_where_every_plan_leaves_the_bounds_chance_decides() -> None:
    spec = trial("pendulum", "icem", 3, env={"state_limit": 3.2}, policy=SMALL)
    for path in ("kernel", "reference"):
        inputs = run_trial(spec, path).inputs
        assert np.abs(np.abs(inputs[np.isfinite(inputs)]) - spec.system.gamma).max() < 1e-12


def test_it_gathers_more_information_than_held_random_inputs() -> None:
    gained = []
    for policy, fields in (
        ("icem", {"lookahead": 20, "hold": 5, "stride": 5}),
        ("random_held", {}),
    ):
        spec = trial("arm", policy, 5, env={"horizon": 100}, policy=fields, learner=GAUSS_NEWTON)
        result = run_trial(spec)
        batch = Lockstep([spec])
        batch.theta.copy_(torch.tensor(result.parameters)[None])
        J = rows_at(batch, result.states[:100])
        gained.append(float(torch.logdet(1e-3 * torch.eye(J.shape[1]) + J.mT @ J)))
    assert gained[0] > gained[1] + 20.0


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"lookahead": 31}, "policy.lookahead is 31 steps, but a trial of env 'pendulum' has 30"),
        ({"stride": 8}, "policy.stride is 8 steps, but the plans have 7"),
        ({"elites": 10}, "policy.elites is 10, but an iteration draws 9 plans"),
    ],
)
def test_settings_that_make_no_plan_are_refused(fields: dict[str, int], sentence: str) -> None:
    with pytest.raises(IncompatibleError, match=sentence):
        trial("pendulum", "icem", policy=SMALL | fields)
