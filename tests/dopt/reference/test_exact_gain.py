"""Definition 1: the exact gain, its optimum, and how far Proposition 1 falls short of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import grad_and_value, jacrev

from benchmarks.linearisation_gap import linearisation_gaps
from dopt.policies.gradient import GradientDOptimal
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.exact_gain import (
    ExactGain,
    Situation,
    ascend,
    log_det_gain,
)
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from tests.close import assert_close
from tests.dopt.reference.batch import circle, situation, step_from
from tests.dopt.torch_models import for_one
from tests.dopt.trials import trial

SHORT = {"horizon": 7}
SEARCH = GradientDOptimal(candidates=16, starts=2, iterations=5)
ENVS = ["pendulum", "cartpole", "arm", "quadrotor"]


def definition(spec: TrialSpec, seed: int, u: Tensor) -> float:
    """Return log det[M + J(x(u))ᵀ J(x(u))] - log det M, both q × q."""
    now = situation(spec, seed)
    J = jacrev(for_one(now.model))(now.theta, step_from(spec, now, u))
    return float(torch.logdet(now.information + J.mT @ J) - torch.logdet(now.information))


def on_sphere_of(spec: TrialSpec, points: int) -> Tensor:
    gamma = spec.system.gamma
    two = torch.tensor([[gamma], [-gamma]], dtype=torch.float64)
    return circle(gamma, points) if spec.system.n_inputs == 2 else two


def prepared(spec: TrialSpec, seed: int) -> tuple[Lockstep, Situation]:
    """Return a batch of one trial and a random situation."""
    now = situation(spec, seed)
    covariance = torch.linalg.inv(now.information)
    parts = (now.theta[None], covariance[None], now.state[None], torch.tensor([0]))
    return Lockstep([spec]), Situation(*parts)


@pytest.mark.parametrize("env", ENVS)
def test_the_gain_is_that_of_definition_1(env: str) -> None:
    spec = trial(env, "gradient")
    batch, now = prepared(spec, 1)
    some = on_sphere_of(spec, 5)
    found = ExactGain(batch).values(some[None], now)[0]
    expected = [definition(spec, 1, u) for u in some]
    assert found.numpy() == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_one_component_gains_less_than_all() -> None:
    spec = trial("arm", "gradient")
    batch, now = prepared(spec, 2)
    some = circle(spec.system.gamma, 12)[None]
    single = ExactGain(batch, single=True)
    parts = [single.values(some, now._replace(component=torch.tensor([k]))) for k in range(2)]
    whole = ExactGain(batch).values(some, now)
    assert torch.all(torch.maximum(*parts) <= whole + 1e-12)
    assert torch.all(whole <= parts[0] + parts[1] + 1e-12)


def test_determinants_and_inverses_are_those_of_dense_algebra() -> None:
    rng = torch.Generator().manual_seed(0)
    root, J = (torch.randn(n, 7, generator=rng, dtype=torch.float64) for n in (9, 3))
    M = root.mT @ root
    gain = log_det_gain(J, torch.linalg.inv(M))
    assert float(gain) == pytest.approx(float(torch.logdet(M + J.mT @ J) - torch.logdet(M)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("env", ENVS)
def test_no_input_on_the_sphere_gains_more(env: str, seed: int) -> None:
    spec = trial(env, "gradient")
    batch, now = prepared(spec, seed)
    gain, policy = ExactGain(batch), spec.policy
    assert isinstance(policy, GradientDOptimal)
    chosen = gain.optimum(on_sphere_of(spec, policy.candidates)[None], now, policy)
    assert float(chosen.norm()) == pytest.approx(spec.system.gamma)
    scan = gain.values(on_sphere_of(spec, 720)[None], now)[0]
    found = float(gain.values(chosen[None], now)[0, 0])
    spread = float(scan.max() - scan.min())
    assert found >= float(scan.max()) - 1e-3 * spread


def test_ascent_ends_at_the_top_axis_of_a_quadratic_form() -> None:
    Q = torch.diag(torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64))
    starts = torch.tensor([[1.0, 1.0, 0.3], [-1.0, 0.2, -0.1]], dtype=torch.float64)
    slopes = torch.func.vmap(grad_and_value(lambda u: u @ Q @ u))
    previous = -torch.inf
    for iterations in (0, 3, 10, 60):
        u, value = ascend(slopes, starts, 0.5, iterations)
        assert torch.all(value >= previous)
        assert u.norm(dim=1).numpy() == pytest.approx(starts.norm(dim=1).numpy())
        previous = value
    assert value.numpy() == pytest.approx(5.0 * starts.square().sum(1).numpy(), rel=1e-6)


@pytest.mark.parametrize(("learner", "forgetting"), [("adam_window", 1.0), ("ekf", 0.9)])
@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_the_plan_goes_by_the_information_of_all_steps(
    env: str, learner: str, forgetting: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is one M: a filter's, where it learns, is the one that is planned with."""
    learns = {"name": learner} | ({"forgetting": forgetting} if learner == "ekf" else {})
    policy = {"regularization": 0.1}
    spec = trial(env, "gradient", 2, env={"horizon": 8}, policy=policy, learner=learns)
    batch = Lockstep([spec])
    seen: list[torch.Tensor] = []

    def optimum(_: ExactGain, starts: torch.Tensor, now: Situation, __: object) -> torch.Tensor:
        seen.append(now.covariance[0])
        return starts[:, 0]

    monkeypatch.setattr(ExactGain, "optimum", optimum)
    M = 0.1 * torch.eye(batch.theta.shape[1], dtype=torch.float64)
    with torch.no_grad():
        for t in range(8):
            batch.step(t)
            if t:
                assert_close((seen[-1] @ M).numpy(), np.eye(len(M)), abs=1e-7)
            assert batch.information is not None
            if learner == "ekf":
                M = batch.information.matrix()[0]
            else:
                J = batch.rows(slice(t, t + 1))[0, 0]
                M = M + J.mT @ J
    assert len(seen) == 7


def test_a_batch_is_its_trials_one_by_one() -> None:
    specs = [trial("arm", "gradient", seed, env={"horizon": 8}) for seed in range(2)]
    for spec, many in zip(specs, run_trials(specs), strict=True):
        assert many.inputs == pytest.approx(run_trials([spec])[0].inputs, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("env", ENVS)
def test_the_closed_form_never_beats_the_optimum(env: str) -> None:
    one, together = linearisation_gaps(
        [trial(env, "d_optimal", seed, env=SHORT) for seed in range(2)], SEARCH
    )
    for found in (one, together):
        assert found.best.shape == (2, SHORT["horizon"] - 1)
        assert np.all(found.relative >= 0.0)
        assert np.all(found.relative < 1.0)
        assert np.all(found.of_range <= 1.0)
    assert np.all(together.best >= one.best - 1e-9)


def test_an_input_drawn_at_random_falls_short_for_sure() -> None:
    """The measure can tell: the closed form misses far less than a random direction does."""
    spec = trial("arm", "d_optimal", 1, env=SHORT)
    batch, now = prepared(spec, 1)
    gain = ExactGain(batch)
    best = gain.values(gain.optimum(circle(5.0, 16)[None], now, SEARCH)[None], now)
    values = gain.values(circle(5.0, 100)[None], now)
    one, _ = linearisation_gaps([spec], SEARCH)
    assert float((best - values.mean()) / (best - values.min())) > 0.2 > 10 * one.of_range.mean()


@pytest.mark.parametrize("env", ENVS)
def test_the_shortfall_vanishes_with_the_time_step(env: str) -> None:
    """Even as a share of what the input can change, which itself falls with dt."""
    missed = []
    for dt in (0.1, 1e-4):
        spec = trial(env, "d_optimal", 1, env=SHORT)
        system = dataclasses.replace(spec.system, dt=dt, noise=0.0)
        spec = TrialSpec(TrialConfig(system, spec.policy, spec.model, spec.learner, "reference"))
        one, _ = linearisation_gaps([spec.with_seed(seed) for seed in range(2)], SEARCH)
        missed.append(float(np.mean(one.of_range)))
    assert missed[-1] < 1e-6
    if env == "arm":  # the others' inputs act along a line: only its sign is chosen
        assert missed[0] > 10 * missed[-1] > 0.0
