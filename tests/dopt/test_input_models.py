"""Models that learn what the inputs do, and systems of which that is unknown."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models import MODELS
from dopt.offline_fit import fit_offline, uniform_samples
from dopt.randomness import PLANNED_DIMENSIONS, draw
from dopt.run import run_trial
from dopt.spec.config import PLAN_VERSION
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.kernel.calls import model_of_kernel
from tests.dopt.oracles.traces import jacobian
from tests.dopt.trials import SMALL_GRIDS, SMALL_SEARCHES

READERS = ("affine", "black_box")
UNKNOWN = [name for name, system in SYSTEMS.items() if system.reads_inputs]


def small(
    env: str, model: str = "affine", policy: str = "d_optimal", learner: str = "adam_window",
    /, *, seed: int = 0, **sections: dict[str, Any],
) -> TrialSpec:  # fmt: skip
    parts: dict[str, dict[str, Any]] = {
        "env": {"name": env, "horizon": 12, "grid_points": SMALL_GRIDS[env]},
        "policy": {"name": policy, **SMALL_SEARCHES.get(policy, {})},
        "model": {"name": model} | ({"width": 6} if model in READERS else {}),
        "learner": {"name": learner},
    }
    merged = {key: part | sections.get(key, {}) for key, part in parts.items()}
    return TrialSpec.from_mapping(merged | {"seed": seed})


@pytest.mark.parametrize("model", READERS)
def test_values_and_rows_are_those_of_the_model(model: str) -> None:
    spec = small("arm", model)
    rng = np.random.default_rng(1)
    theta = draw(spec).weights + 0.1 * rng.standard_normal(len(draw(spec).weights))
    x, u = rng.standard_normal((5, 4)), 3.0 * rng.standard_normal((5, 2))
    values, points = spec.model.predict(spec.system, theta, x, u), np.hstack([x, u])
    kernel = model_of_kernel(spec, theta)
    assert kernel.predict(points) == pytest.approx(values, rel=1e-12)
    for point, J in zip(points, jacobian(spec, theta, points), strict=True):
        np.testing.assert_allclose(kernel.jacobian(point), J, rtol=1e-9, atol=1e-12)
        along, step = rng.standard_normal((1, 6)), 1e-5
        change = kernel.jacobian_change(point, along)[0]
        ends = jacobian(spec, theta, point + step * along * np.array([[1.0], [-1.0]]))
        np.testing.assert_allclose(change, (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("model", READERS)
def test_only_one_is_affine_in_the_inputs(model: str) -> None:
    spec, rng = small("arm", model), np.random.default_rng(2)
    theta, x = draw(spec).weights, rng.standard_normal((7, 4))
    first, second = rng.standard_normal((2, 7, 2))
    free, one, other, both = (
        spec.model.predict(spec.system, theta, x, u)
        for u in (0 * first, first, second, first + second)
    )
    apart = np.abs(one + other - both - free).max()
    assert apart < 1e-12 if model == "affine" else apart > 1e-3
    assert np.array_equal(free, spec.model.predict(spec.system, theta, x))


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_effect_moves_the_system_as_a_known_one(name: str) -> None:
    unknown, known = SYSTEMS[name](), SYSTEMS[name.removesuffix("_unknown_gain")]()
    rng = np.random.default_rng(5)
    for x, u in zip(rng.standard_normal((9, known.n_states)), rng.standard_normal(9), strict=True):
        expected = known.derivative(x, [u])
        assert unknown.derivative(x, [u]) == pytest.approx(expected, rel=1e-12)
        assert not np.any(
            np.array(unknown.known(x, [u], unknown.parameters))[list(unknown.learned_rows)]
        )
    weak = SYSTEMS[name](gain=0.5)  # type: ignore[call-arg]
    assert weak.derivative(x, [u]) == pytest.approx(known.derivative(x, [0.5 * u]), rel=1e-12)


@pytest.mark.parametrize("name", UNKNOWN)
def test_the_oracle_learns_the_gain(name: str) -> None:
    spec = small(name, "linear", "oracle", "recursive_least_squares",
                 env={"horizon": 200, "gain": 1.3})  # fmt: skip
    result = run_trial(spec)
    assert result.parameters[-1] == pytest.approx(1.3, rel=0.02)


@pytest.mark.parametrize("model", READERS)
def test_the_loss_is_the_error_over_states_and_inputs(model: str) -> None:
    spec = small("cartpole_unknown_gain", model)
    result, points = run_trial(spec), evaluation_set(spec.system)
    assert np.abs(points.inputs[: points.n_grid]).max() <= spec.system.gamma
    truth = spec.system.learned(points.states, inputs=points.inputs)
    errors = truth - spec.model.predict(
        spec.system, result.parameters, points.states, points.inputs
    )
    squares = np.sum(errors**2, axis=1)
    assert result.loss[-1] == pytest.approx(np.sqrt(squares[: points.n_grid].mean()), rel=1e-5)
    reachable = np.sqrt(squares[points.n_grid :].mean())
    assert result.reachable_loss[-1] == pytest.approx(reachable, rel=1e-5)


def test_samples_of_states_and_inputs_are_fitted_offline() -> None:
    spec = small("pendulum_unknown_gain", env={"horizon": 300, "grid_points": [8, 8]})
    samples = uniform_samples(spec)
    given = (spec, samples.states, samples.accelerations)
    fitted = fit_offline(*given, inputs=samples.inputs)
    size = float(np.sqrt(np.mean(samples.accelerations**2)))
    assert fitted.loss < 0.02 * size
    with pytest.raises(SpecificationError, match="'affine' reads inputs, but none were given"):
        fit_offline(*given)
    with pytest.raises(SpecificationError, match="300 states and 299 inputs"):
        fit_offline(*given, inputs=samples.inputs[1:])


@pytest.mark.parametrize(("model", "width"), [("affine", 6), ("black_box", 16)])
def test_d_optimal_inputs_teach_more_than_random_ones(model: str, width: int) -> None:
    """On the pendulum with an unknown gain, in the median of ten seeds."""

    def paper(policy: str, seed: int) -> TrialSpec:
        env = {"horizon": 500, "grid_points": [16, 16]}
        sections = {"env": env, "model": {"width": width}}
        return small("pendulum_unknown_gain", model, policy, seed=seed, **sections)

    losses = [
        [run_trial(paper(policy, seed)).loss[-1] for seed in range(10)]
        for policy in ("d_optimal", "random")
    ]
    assert np.median(np.array(losses[0]) / np.array(losses[1])) < 0.5


@pytest.mark.parametrize("env", ["cartpole_unknown_gain", "arm"])
def test_inputs_fill_the_ball_where_their_effect_is_not_affine(env: str) -> None:
    spec = small(env, "black_box", env={"horizon": 300})
    gamma, m, drawn = spec.system.gamma, spec.system.n_inputs, draw(spec)
    norms = np.linalg.norm(run_trial(spec).inputs, axis=1) / gamma
    assert norms[1:] == pytest.approx(drawn.radii[1:, 0], rel=1e-9)
    assert np.linalg.norm(run_trial(small(env)).inputs, axis=1) == pytest.approx(gamma, rel=1e-12)
    # Of n dimensions, the n-th power of a uniform point's norm is uniform between 0 and 1.
    for radii, dimensions in zip(drawn.radii.T, (PLANNED_DIMENSIONS * m, m), strict=True):
        assert kstest(radii**dimensions, "uniform").pvalue > 0.01
    assert abs(np.corrcoef(drawn.radii.T)[0, 1]) < 0.2
    uniform = np.linalg.norm(uniform_samples(spec).inputs, axis=1) / gamma
    assert kstest(uniform**m, "uniform").pvalue > 0.01


def test_trials_with_other_plans_have_other_keys() -> None:
    """Those of an earlier version took inputs of norm γ alone."""

    def version(model: str, policy: str) -> object:
        return json.loads(small("arm", model, policy).config_json).get("plan_version")

    assert version("black_box", "d_optimal") == PLAN_VERSION
    assert version("black_box", "trace_linearized") == PLAN_VERSION
    assert version("black_box", "random") is None
    assert version("affine", "d_optimal") is None
    assert version("mlp", "d_optimal") is None


def test_what_reads_no_inputs_is_refused() -> None:
    with pytest.raises(IncompatibleError, match="a model that learns the effect of the inputs"):
        small("pendulum_unknown_gain", "mlp")
    with pytest.raises(IncompatibleError, match="policy 'gradient' goes with a model of the state"):
        small("arm", "affine", "gradient")
    with pytest.raises(IncompatibleError, match="'primal' or 'sketch'"):
        small("arm", "affine", policy={"form": "dual"})
    with pytest.raises(IncompatibleError, match="'auto', which takes 'dual' here"):
        small("arm", "affine", model={"width": 64}, env={"horizon": 500})
    small("arm", "black_box", policy={"form": "dual"})


def test_the_models_that_read_inputs_are_these() -> None:
    system = SYSTEMS["arm"]()
    assert {name for name, model in MODELS.items() if model().n_inputs_read(system)} == set(READERS)
