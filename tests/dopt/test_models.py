"""Models linear in their parameters, grey boxes, ensembles, and models that read inputs."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from dopt.assessment import parameter_error
from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import evaluation_set
from dopt.kernel.run import KernelTrial
from dopt.models import MODELS, RFF, GaussianProcess
from dopt.models.gaussian_process import kernel
from dopt.offline_fit import fit_offline
from dopt.randomness import PLANNED_DIMENSIONS, draw
from dopt.run import rerun, run_trial
from dopt.spec.config import PLAN_VERSION
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.kernel.twin import check_inverse, model_of_kernel
from tests.dopt.oracles.traces import jacobian, observed
from tests.dopt.trials import trial, uniform_samples

LEARNERS = {"rff": "recursive_least_squares", "linear_state": "recursive_least_squares"} | {
    "gaussian_process": "conditioning"
}


def regression(env: str, model: str, policy: str = "random_held", /, **fields: Any) -> TrialSpec:
    """Return a small trial with one of the models."""
    sections: dict[str, Any] = {"model": {"name": model}, "learner": {"name": LEARNERS[model]}}
    if policy in ("d_optimal", "linear"):
        sections["policy"] = {"regularization": 1e-2}
    for key, entries in fields.items():
        sections[key] = sections.get(key, {}) | entries
    return trial(env, policy, 5, **sections)


def test_random_features_have_the_kernel_in_expectation() -> None:
    model = RFF(n_features=40_000, lengthscale=0.7, amplitude=3.0)
    system = trial("pendulum", "random").system
    drawn = model.initial_parameters(system, np.random.default_rng(0))
    states = np.random.default_rng(1).normal(size=(5, 2))
    first = model.n_features
    frequencies = drawn[first:-first].reshape(first, 3)
    psi = model.scale * np.cos(system.featurize(states) @ frequencies.T + drawn[-first:])
    phi = system.featurize(states)
    numbers = np.array([0.7**-2] * phi.shape[1] + [9.0] + [0.0] * (phi.shape[1] + 2))
    expected = kernel(numbers, phi, phi)
    assert psi @ psi.T == pytest.approx(expected, abs=0.15)


def test_random_features_stay_and_differ_from_seed_to_seed() -> None:
    spec = regression("arm", "rff")
    result = run_trial(spec)
    fixed = spec.model.n_fixed_parameters(spec.system)
    before = draw(spec).weights
    assert np.array_equal(result.parameters[-fixed:], before[-fixed:])
    assert np.all(before[:-fixed] == 0.0)
    assert np.all(result.parameters[:-fixed] != 0.0)
    assert np.all(draw(spec.with_seed(6)).weights[-fixed:] != before[-fixed:])


@pytest.mark.parametrize("policy", ["random_held", "d_optimal"])
@pytest.mark.parametrize(("env", "model"), [("arm", "rff"), ("mass_spring", "linear_state")])
def test_least_squares_minimise_the_ridge_loss_and_hold_its_matrix(
    env: str, model: str, policy: str
) -> None:
    """With the ridge of a policy that plans by the same matrix, or their own."""
    spec = regression(env, model, policy, learner={"regularization": 3e-2})
    fast = KernelTrial(spec)
    fast.advance(spec.system.horizon)
    states, targets = fast.states[:-1], observed(spec, fast.record)
    q = spec.model.n_parameters(spec.system) - spec.model.n_fixed_parameters(spec.system)
    units = np.concatenate([np.eye(q), np.tile(draw(spec).weights[q:], (q, 1))], axis=1)
    columns = [spec.model.predict(spec.system, unit, states).ravel() for unit in units]
    J, ridge = np.stack(columns, axis=1), 1e-2 if policy == "d_optimal" else 3e-2
    check_inverse(fast, ridge * np.eye(q) + J.T @ J, 1e-8)
    design = np.concatenate([J, np.sqrt(ridge) * np.eye(q)])
    aims = np.concatenate([targets.ravel(), np.zeros(q)])
    expected = np.linalg.lstsq(design, aims, rcond=None)[0]
    found = fast.parameters[:q]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-7 * np.abs(expected).max())


def test_the_noise_of_a_process_is_that_of_the_trial_but_not_below_rounding() -> None:
    spec = regression("pendulum", "gaussian_process", env={"noise": 0.1})
    assert isinstance(spec.model, GaussianProcess)
    assert spec.model.noise_variance(spec.system) == pytest.approx(0.1**2 / 0.02)
    quiet = regression("pendulum", "gaussian_process", env={"noise": 0.0})
    assert spec.model.noise_variance(quiet.system) == pytest.approx(1e-8)
    assert run_trial(quiet).diverged_at is None


def grey(
    system: str, policy: str, model: dict[str, Any], learner: dict[str, Any], **fields: Any
) -> TrialSpec:
    return trial(system, policy, 0, model={"name": "grey_box"} | model, learner=learner, **fields)


@pytest.mark.parametrize("env", ["pendulum_unknown_gain", "cartpole", "quadrotor"])
def test_with_linear_parameters_it_is_the_linear_model(env: str) -> None:
    """The filter of both takes the same steps; an effect of the inputs is a parameter as others."""
    filtered = {"name": "ekf", "regularization": 1e-3}
    linear = trial(env, "random", 0, model={"name": "linear"}, learner=filtered)
    q = linear.model.n_parameters(linear.system)
    box = grey(env, "random", {"initial": [0.0] * q, "spread": 0.0}, filtered)
    one, other = (run_trial(spec) for spec in (linear, box))
    assert other.parameters == pytest.approx(one.parameters, rel=1e-6, abs=1e-9)
    assert other.loss == pytest.approx(one.loss, rel=1e-6, abs=1e-9)


def test_parameters_that_enter_nonlinearly_are_found() -> None:
    spec = grey(
        "moving_star",
        "random",
        {"unknown": ["radius", "core"], "initial": [0.4, 0.05], "spread": 0.0},
        {"name": "gauss_newton", "regularization": 1e-8, "steps": 3},
        env={"period": 1e6, "initial_state": [0.87, 0.0], "noise": 0.0},
    )
    found = rerun(spec, [1, 30]).parameters
    errors = [parameter_error(spec.system, theta, 0, ["radius", "core"]) for theta in found]
    assert errors[1] < 1e-4 < 0.05 < errors[0]


def test_a_moving_star_is_followed_by_a_fit_of_the_newest_samples() -> None:
    names = ["center_x", "center_y"]
    spec = grey(
        "moving_star",
        "random",
        {"unknown": names, "initial": [0.95, 0.05], "spread": 0.0},
        {"name": "gauss_newton", "capacity": 5, "regularization": 1e-8, "steps": 3},
    )
    (theta,) = rerun(spec, [30]).parameters
    assert parameter_error(spec.system, theta, 29, names) < 0.03
    assert parameter_error(spec.system, theta, 0, names) > 0.1


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ({"unknown": ["gravity", "weight"]}, r"model\.unknown goes with names out of mass, length"),
        ({"unknown": ["gravity", "gravity"]}, "none of them twice"),
        ({"unknown": ["gravity"], "initial": [1.0, 2.0]}, "one number for each of gravity"),
    ],
)
def test_unknown_parameters_are_the_systems_own(model: dict[str, Any], words: str) -> None:
    with pytest.raises(IncompatibleError, match=words):
        grey("pendulum", "random", model, {"name": "adam"})


def test_initial_parameters_scatter_about_the_guess_by_the_seed() -> None:
    spec = grey("pendulum", "random", {"unknown": ["mass"], "initial": [2.0]}, {"name": "adam"})
    drawn = [
        spec.model.initial_parameters(spec.system, np.random.default_rng(seed))[0]
        for seed in range(200)
    ]
    assert np.mean(drawn) == pytest.approx(2.0, abs=0.03)
    assert np.std(drawn) == pytest.approx(0.1, rel=0.2)


STEPS = 9
ENSEMBLE = {"name": "ensemble", "members": 4}
GAUSS_NEWTON = {"name": "gauss_newton"}


def make(
    model: dict[str, Any], policy: str = "d_optimal", learner: dict[str, Any] = GAUSS_NEWTON
) -> TrialSpec:
    return trial("arm", policy, 5, env={"horizon": STEPS}, model=model, learner=learner)


def members_of(parameters: np.ndarray) -> np.ndarray:
    return parameters.reshape(ENSEMBLE["members"], -1)


@pytest.mark.parametrize("policy", ["d_optimal", "icem"])
def test_it_explores_as_its_first_member_does_alone(policy: str) -> None:
    found, alone = run_trial(make(ENSEMBLE, policy)), run_trial(make({"name": "mlp"}, policy))
    np.testing.assert_array_equal(found.states, alone.states)
    np.testing.assert_array_equal(members_of(found.parameters)[0], alone.parameters)
    assert not np.allclose(found.loss, alone.loss)


def test_the_prediction_is_the_mean_of_the_members() -> None:
    spec = make(ENSEMBLE)
    theta, states = draw(spec).weights, evaluation_set(spec.system).states[:5]
    alone = make({"name": "mlp"}).model
    members = [alone.predict(spec.system, one, states) for one in members_of(theta)]
    found = spec.model.predict(spec.system, theta, states)
    np.testing.assert_allclose(found, np.mean(members, axis=0), rtol=1e-12)


@pytest.mark.parametrize(
    ("learner", "words"),
    [
        ({"name": "adam_window"}, "and model 'ensemble' with learner 'gauss_newton', but the two"),
        ({"name": "gauss_newton", "refit_every": 2}, "but learner.refit_every 2 was given"),
    ],
)
def test_learners_that_keep_something_of_one_network_are_refused(
    learner: dict[str, Any], words: str
) -> None:
    with pytest.raises(IncompatibleError, match=words):
        make(ENSEMBLE, learner=learner)


READERS = ("affine", "black_box")
UNKNOWN = [name for name, system in SYSTEMS.items() if system.reads_inputs]


def small(
    env: str, model: str = "affine", policy: str = "d_optimal", learner: str = "adam_window",
    /, *, seed: int = 0, **sections: dict[str, Any],
) -> TrialSpec:  # fmt: skip
    """Return a small trial with a model that reads inputs."""
    width = {"width": 6} if model in READERS else {}
    parts: dict[str, dict[str, Any]] = {
        "env": {"horizon": 12}, "model": {"name": model} | width, "learner": {"name": learner},
    }  # fmt: skip
    keys = {*parts, *sections}
    merged = {key: parts.get(key, {}) | sections.get(key, {}) for key in keys}
    return trial(env, policy, seed, **merged)


@pytest.mark.parametrize("model", [*READERS, "rff"])
def test_values_and_rows_are_those_of_the_model(model: str) -> None:
    spec = small("arm", model, "d_optimal", LEARNERS.get(model, "adam_window"))
    rng = np.random.default_rng(1)
    theta, q = draw(spec).weights.copy(), len(KernelTrial(spec).state.theta)  # features stay
    theta[:q] += 0.1 * rng.standard_normal(q)
    x, u = rng.standard_normal((5, 4)), 3.0 * rng.standard_normal((5, 2))
    points = np.hstack([x, u]) if model in READERS else x
    values = spec.model.predict(spec.system, theta, x, u)
    kernel = model_of_kernel(spec, theta[:q])
    assert kernel.predict(points) == pytest.approx(values, rel=1e-12)
    for point, J in zip(points, jacobian(spec, theta, points), strict=True):
        np.testing.assert_allclose(kernel.jacobian(point), J, rtol=1e-9, atol=1e-12)
        along, step = rng.standard_normal((1, points.shape[1])), 1e-5
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
    inputs = evaluation_set(spec.system).inputs
    assert np.linalg.norm(inputs, axis=1).max() <= gamma * (1 + 1e-12)
    uniform = np.linalg.norm(uniform_samples(spec).inputs, axis=1) / gamma
    assert kstest(uniform**m, "uniform").pvalue > 0.01


def test_trials_with_other_plans_have_other_keys() -> None:
    """Trials of an earlier version took inputs of norm γ alone."""

    def version(model: str, policy: str) -> object:
        return json.loads(small("arm", model, policy).config_json).get("plan_version")

    assert version("black_box", "d_optimal") == PLAN_VERSION
    assert version("black_box", "trace_linearized") == PLAN_VERSION
    assert version("black_box", "random") is None
    assert version("affine", "d_optimal") is None
    assert version("mlp", "d_optimal") is None


@pytest.mark.parametrize("name", sorted(MODELS))
def test_predictions_are_refused_at_rows_of_another_size(name: str) -> None:
    """A number too many was left out, and the prediction looked like any other."""
    model = MODELS[name]()
    unknown = name in ("affine", "black_box")
    system = SYSTEMS["pendulum_unknown_gain" if unknown else "pendulum"]()
    theta = model.initial_parameters(system, np.random.default_rng(0))
    at = np.array([[0.1, 0.2]])
    assert model.predict(system, theta, at).shape == (1, 1)
    for states in (np.zeros((1, 3)), np.zeros((1, 1))):
        with pytest.raises(SpecificationError, match="states of shape"):
            model.predict(system, theta, states)
    with pytest.raises(SpecificationError, match="inputs of shape"):
        model.predict(system, theta, at, np.zeros((1, 2)))
    with pytest.raises(SpecificationError, match="parameters"):
        model.predict(system, np.append(theta, 0.0), at)


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
