"""Trials of changing systems, divergence, reruns, random streams and forecasts."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from dopt.assessment import model_forecast, true_forecast
from dopt.control.planning import forecast_by, forecast_by_equations
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set, simulate
from dopt.models import MLP, RFF, Ensemble, Linear
from dopt.randomness import _STREAMS, draw, stream
from dopt.reference.batch import run_trials
from dopt.result import TrialResult
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, DriftingPendulum, Pendulum
from dopt.systems.base import INTEGRATORS, System
from tests.dopt.trials import KNOWN_EFFECT, MODELS, PAIRS, covering, trial

DRIFT = {"final_friction": 2.0, "time_constant": 0.3, "friction": 0.1}


def test_friction_tends_exponentially_to_its_end() -> None:
    system = DriftingPendulum(**DRIFT, horizon=200)
    friction = system.history[:, 3]
    assert friction[0] == 0.1
    assert friction[15] == pytest.approx(2.0 - 1.9 / math.e)
    assert friction[-1] == pytest.approx(2.0, abs=1e-4)
    assert np.ptp(system.history[:, :3], axis=0).tolist() == [0, 0, 0]


def test_the_truth_at_a_step_is_that_of_a_pendulum_of_that_friction() -> None:
    system, states = DriftingPendulum(**DRIFT), np.array([[0.3, 2.0], [2.0, -5.0]])
    for step in (0, 7, 999):
        plain = Pendulum(friction=float(system.history[step, 3]))
        assert system.learned(states, step) == pytest.approx(plain.learned(states), rel=1e-14)
    each = np.stack([system.learned(states[:1], 4)[0], system.learned(states[1:], 9)[0]])
    assert np.array_equal(system.learned(states, [4, 9]), each)
    assert np.array_equal(system.learned(states, 5_000), system.learned(states, 999))


@pytest.mark.parametrize("path", ["kernel", "reference"])
def test_the_observed_path_is_that_of_the_changing_system(path: Any) -> None:
    spec = trial("drifting_pendulum", "random", env=DRIFT | {"noise": 0.0})
    result = run_trial(spec, path)
    x = np.array(spec.system.initial_state)
    for t, u in enumerate(result.inputs):
        plain = Pendulum(friction=float(spec.system.history[t, 3]))
        x = x + plain.dt * plain.derivative(x, u)
        assert result.states[t + 1] == pytest.approx(x, rel=1e-9, abs=1e-12)
    assert simulate(spec.system, result.inputs[:, None])[:, 0] == pytest.approx(result.states)


RFF_LEAST_SQUARES = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
ENSEMBLE = {"model": {"name": "ensemble", "members": 4}, "learner": {"name": "gauss_newton"}}
DRIFTING = {"env": DRIFT | {"grid_points": (20, 20)}}


@pytest.mark.parametrize(
    ("env", "policy", "parts"),
    [
        ("drifting_pendulum", "random", DRIFTING),
        ("drifting_pendulum", "oracle", DRIFTING),
        ("drifting_pendulum", "gaussian_process", DRIFTING),
        ("drifting_pendulum", "random", DRIFTING | RFF_LEAST_SQUARES),
        ("arm", "d_optimal", ENSEMBLE),
        ("cartpole_unknown_gain", "d_optimal", {"model": {"name": "affine"}}),
        ("cartpole_unknown_gain", "d_optimal", {"model": {"name": "black_box"}}),
    ],
)
def test_the_loss_of_a_step_is_that_against_the_truth_of_the_step(
    env: str, policy: str, parts: Any
) -> None:
    """Over the grid and over the reachable states, with inputs where the model reads them."""
    spec = trial(env, policy, **parts)
    system, points = spec.system, evaluation_set(spec.system)
    seen, result = rerun(spec, range(1, 31)), run_trial(spec)
    n, at = points.n_grid, system.points(points.states, points.inputs)
    for t, theta in enumerate(seen.parameters):
        errors = spec.model.predict_at(system, theta, at)
        errors = errors - system.learned(points.states, t, points.inputs)
        squares = np.sum(errors**2, axis=1)
        losses = result.loss[t], result.reachable_loss[t]
        expected = np.sqrt(squares[:n].mean()), np.sqrt(squares[n:].mean())
        assert losses == pytest.approx(expected, rel=1e-5)


def test_without_a_drift_it_is_the_pendulum() -> None:
    plain = trial("pendulum", "d_optimal", 2)
    still = DriftingPendulum(horizon=30, grid_points=(4, 4), final_friction=1 / 6)
    same = TrialSpec(dataclasses.replace(plain.config, system=still), 2)
    one, two = run_trial(plain), run_trial(same)
    assert np.array_equal(one.states, two.states)
    assert np.array_equal(one.parameters, two.parameters)
    assert two.loss == pytest.approx(one.loss, rel=1e-6)


def test_forgetting_follows_a_drift_that_memory_averages() -> None:
    """Paired over seeds: the loss in the second half of the trial, against the truth of then."""

    def losses(forgetting: float) -> np.ndarray:
        parts: dict[str, Any] = {"env": {"horizon": 600, "grid_points": (16, 16)}}
        parts |= {"model": {"name": "linear"}, "learner": {"name": "ekf", "forgetting": forgetting}}
        specs = [trial("drifting_pendulum", "random_held", seed, **parts) for seed in range(8)]
        return np.array([run_trial(spec).loss[300:].mean() for spec in specs])

    gain = np.log(losses(1.0) / losses(0.98))
    assert stats.ttest_1samp(gain, 0.0, alternative="greater").pvalue < 1e-3
    assert np.exp(gain.mean()) > 3.0


COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us", "states", "inputs")
POLICIES = ["random", "uniform", "d_optimal", "oracle"]
DAMPING = {"cartpole": "pivot_friction", "mass_spring": "damping"}


def leaving(policy: str, seed: int = 0) -> TrialSpec:
    """Return a trial whose state leaves a narrow limit after some steps."""
    limit = {"random": 0.3, "oracle": 0.8}.get(policy, 1.5)
    return trial("arm", policy, seed, env={"state_limit": limit, "noise": 0.2})


def check_rows(result: TrialResult) -> int:
    """Check that exactly the rows from the divergence on are NaN; return where it is."""
    end = result.diverged_at
    assert end is not None
    for name in COLUMNS:
        rows = getattr(result, name)
        assert np.isnan(rows[end:]).all(), name
        assert np.isfinite(rows[:end]).all(), name
    assert result.diverged
    assert result.n_steps == end
    assert result.final_loss is None
    assert result.best_loss == (result.loss[:end].min() if end else None)
    return end


@pytest.mark.parametrize("policy", POLICIES)
def test_a_state_beyond_the_limit_ends_a_trial(policy: str) -> None:
    spec = leaving(policy)
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    end = check_rows(fast)
    assert 1 < end < 30
    assert check_rows(plain) == end
    limit = spec.system.state_limit
    assert np.abs(fast.states[:end]).max() <= limit
    free = run_trial(trial("arm", policy, env={"noise": 0.2}), "kernel")
    assert np.array_equal(free.states[:end], fast.states[:end])
    assert np.abs(free.states[end + 1]).max() > limit
    assert fast.states[:end] == pytest.approx(plain.states[:end], rel=1e-8, abs=1e-10)
    assert fast.parameters == pytest.approx(plain.parameters, rel=1e-7, abs=1e-10)


@pytest.mark.parametrize("rate", [1e3, 1e30, 1e154, 1e300])
@pytest.mark.parametrize("policy", ["random", "uniform", "d_optimal"])
def test_any_learning_rate_gives_a_result(policy: str, rate: float) -> None:
    """The trial ends, or goes on with poor numbers: it never raises."""
    for env in ("pendulum", "arm"):
        spec = trial(env, policy, env={"horizon": 8}, learner={"learning_rate": rate})
        fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
        assert fast.diverged_at == plain.diverged_at
        assert fast.diverged or rate < 1e300
        for result in (fast, plain):
            if result.diverged:
                check_rows(result)
            else:
                assert np.isfinite(result.loss).all()


@pytest.mark.parametrize(("env", "policy"), covering(PAIRS))
def test_a_step_too_long_for_the_system_ends_a_trial(env: str, policy: str) -> None:
    fields: dict[str, Any] = {"dt": 40.0, "state_limit": 50.0}
    if policy == "periodic":
        fields[DAMPING.get(env, "friction")] = 0.0
    result = run_trial(trial(env, policy, env=fields), "kernel")
    check_rows(result)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_trial_that_diverges_takes_no_other_of_its_batch_along(policy: str) -> None:
    together = run_trials([leaving(policy, seed) for seed in range(4)])
    assert len({result.diverged_at for result in together}) > 1
    for seed, many in enumerate(together[:2]):
        one = run_trial(leaving(policy, seed), "kernel")
        assert one.diverged_at == many.diverged_at
        end = check_rows(many)
        assert many.states[:end] == pytest.approx(one.states[:end], rel=1e-8, abs=1e-10)


def test_a_state_beyond_the_limit_from_the_start_leaves_no_row() -> None:
    env = {"state_limit": 0.5, "initial_state": [1.0, 0.0]}
    for path in ("kernel", "reference"):
        result = run_trial(trial("pendulum", "d_optimal", env=env), path)  # type: ignore[arg-type]
        assert check_rows(result) == 0
        assert result.best_loss is None


def test_the_properties_of_a_whole_trial() -> None:
    result, again = (run_trial(trial("pendulum", "random")) for _ in range(2))
    assert len({result, again}) == 2, "results compare by identity"
    assert (result.diverged, result.diverged_at, result.n_steps) == (False, None, 30)
    assert result.final_loss == result.loss[-1]
    assert result.best_loss == result.loss.min()
    assert (result.states.shape, result.inputs.shape) == ((31, 2), (30, 1))
    assert len(result.parameters) == 64 + 272 + 17
    assert result.wall_seconds > 0.0 <= result.cpu_seconds


def specification(env: str = "pendulum", policy: str = "d_optimal", **model: object) -> TrialSpec:
    return trial(env, policy, 3, env={"horizon": 40}, model=model)


@pytest.mark.parametrize("policy", ["d_optimal", "oracle", "random"])
def test_looking_on_the_way_changes_nothing(policy: str) -> None:
    spec = specification(policy=policy)
    seen, whole = rerun(spec, [0, 7, 8, 40]), run_trial(spec)
    np.testing.assert_array_equal(seen.states, whole.states)
    np.testing.assert_array_equal(seen.parameters[-1], whole.parameters)
    assert seen.steps.tolist() == [0, 7, 8, 40]


def test_a_trial_that_diverges_is_seen_until_then() -> None:
    for path in ("kernel", "reference"):
        mapping = {**specification(policy="random").to_mapping(), "path": path}
        env = {**mapping["env"], "state_limit": 0.4}  # type: ignore[dict-item]  # a section
        spec = TrialSpec.from_mapping({**mapping, "env": env})
        seen, whole = rerun(spec, [0, 3, 40]), run_trial(spec)
        assert whole.diverged_at is not None
        assert 3 < whole.diverged_at < 40
        assert seen.steps.tolist() == [0, 3]
        np.testing.assert_array_equal(seen.states, whole.states)


def test_steps_ascend_from_the_first() -> None:
    assert rerun(specification(), []).parameters.shape == (0, 353)
    for steps, words in (([5, 5], "do not ascend"), ([-3, 10], "-3 was asked .* the first is 0")):
        with pytest.raises(SpecificationError, match=words):
            rerun(specification(), steps)


STREAMS = tuple(_STREAMS)


@pytest.mark.parametrize("env", KNOWN_EFFECT)
def test_policies_that_are_compared_share_noise_and_initial_weights(env: str) -> None:
    policies = [policy for e, policy in PAIRS if e == env]
    specs = [trial(env, policy, 11) for policy in policies if policy not in MODELS]
    first, *others = (draw(spec) for spec in specs)
    assert len(others) > 2
    for other in others:
        for name in ("noise", "weights", "components", "ties"):
            assert np.array_equal(getattr(first, name), getattr(other, name)), name
    for policy in {"oracle", *policies} & set(MODELS):  # whose models are no networks
        assert np.array_equal(first.noise, draw(trial(env, policy, 11)).noise)


def test_draws_that_longer_trials_and_wider_networks_leave_alone() -> None:
    first, other = (draw(trial("arm", "d_optimal", seed)) for seed in (3, 4))
    long = draw(trial("arm", "d_optimal", 3, env={"horizon": 70}))
    assert np.array_equal(first.noise, long.noise[:30])
    assert np.array_equal(first.weights, long.weights)
    wide = draw(trial("arm", "d_optimal", 3, model={"width": 32, "depth": 3}))
    assert len(wide.weights) > len(first.weights)
    for name in ("noise", "inputs", "components", "ties"):
        assert np.array_equal(getattr(first, name), getattr(wide, name)), name
    for name in ("noise", "weights", "inputs"):
        assert not np.any(getattr(first, name) == getattr(other, name)), name


def test_streams_are_not_correlated() -> None:
    rows = np.stack(
        [stream(seed, name).standard_normal(10_000) for seed in (0, 1) for name in STREAMS]
    )
    correlations = np.corrcoef(rows) - np.eye(len(rows))
    assert np.abs(correlations).max() < 0.05


def test_components_and_ties_have_no_preference() -> None:
    """A component is one of the learned ones, a tie a unit vector."""
    drawn = draw(trial("arm", "d_optimal", env={"horizon": 10_000}))
    assert set(drawn.components.tolist()) == {0, 1}
    assert drawn.components.mean() == pytest.approx(0.5, abs=0.03)
    assert np.linalg.norm(drawn.ties, axis=1) == pytest.approx(1.0)
    assert np.abs(drawn.ties.mean(axis=0)).max() < 0.05


def test_the_noise_has_variance_dt_sigma_squared() -> None:
    spec = trial("quadrotor", "random", env={"horizon": 20_000, "dt": 0.04, "noise": 0.3})
    noise = draw(spec).noise
    assert noise.var(axis=0) == pytest.approx(0.04 * 0.3**2, rel=0.05)
    assert noise.mean(axis=0) == pytest.approx(0.0, abs=5 * 0.3 * 0.2 / np.sqrt(20_000))


def test_weights_are_uniform_within_one_over_root_fan_in() -> None:
    spec = trial("arm", "d_optimal", model={"width": 64, "depth": 2})
    weights = np.split(draw(spec).weights, np.cumsum([7 * 64, 65 * 64]))
    for layer, fan_in in zip(weights, (6, 64, 64), strict=True):
        bound = 1 / np.sqrt(fan_in)
        assert 0.9 * bound < np.abs(layer).max() <= bound
    assert weights[1].std() == pytest.approx(1 / np.sqrt(3 * 64), rel=0.05)


STATES, STEPS = 7, 12
CHANGING = {"drifting_pendulum", "moving_star"}
"""Systems that a forecast takes to stay as they are at the start."""


NETWORKS = [MLP(), MLP(width=5, depth=3), Ensemble(members=3, width=5)]
FORECAST = [*NETWORKS, Linear(), RFF(n_features=20)]


def asked(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return random states about the start, (N, d), and inputs, (N, H, m)."""
    rng = np.random.default_rng(4)
    states = system.initial_state + 0.5 * rng.standard_normal((STATES, system.n_states))
    return states, rng.standard_normal((STATES, STEPS, system.n_inputs))


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_every_model_is_rolled_as_its_predictions_say(name: str) -> None:
    system = SYSTEMS[name]()
    for model in FORECAST:
        parameters = np.random.default_rng(1).standard_normal(model.n_parameters(system))
        if isinstance(model, Linear):  # drags brake, and are small enough for the Euler map
            parameters = 0.01 * np.abs(parameters)
        predict = functools.partial(model.predict, system, parameters)
        expected = forecast_by(system, predict)(*asked(system))
        found = model_forecast(system, model, parameters)(*asked(system))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_forecasts_are_the_simulation_of_the_evaluation(name: str) -> None:
    system = SYSTEMS[name]()
    at_first = forecast_by_equations(system)(*asked(system))
    np.testing.assert_allclose(true_forecast(system)(*asked(system)), at_first, rtol=1e-12)
    for integrator in INTEGRATORS if name not in CHANGING else ():
        system = SYSTEMS[name](integrator=integrator)
        _, inputs = asked(system)
        starts = np.tile(system.initial_state, (STATES, 1))
        expected = simulate(system, inputs.swapaxes(0, 1))[1:]
        found = true_forecast(system)(starts, inputs)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)


def test_numbers_that_overflow_are_not_finite() -> None:
    pendulum, model = Pendulum(), MLP()
    parameters = np.full(model.n_parameters(pendulum), 1e308)
    states, inputs = asked(pendulum)
    found = model_forecast(pendulum, model, parameters)(states, inputs)
    assert not np.any(np.isfinite(found[-1]))
