"""Time steps: the Euler map and the method of Runge and Kutta, in numpy, torch and the kernel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from dopt import Explorer, Plant
from dopt.assessment import model_forecast, true_forecast
from dopt.control.planning import forecast_by_equations
from dopt.errors import SpecificationError
from dopt.evaluation import simulate
from dopt.kernel.from_spec import plant_of
from dopt.kernel.integration import next_true_state
from dopt.models import MLP
from dopt.offline_fit import recorded_samples
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, System
from dopt.systems.base import INTEGRATORS, next_state
from tests.dopt.kernel.calls import call
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import LEARNERS, MODELS, SMALL_GRIDS, SMALL_SEARCHES
from tests.paths import EXAMPLE


def integrated(
    env: str, policy: str = "d_optimal", /, *, model: str | None = None,
    learner: str | None = None, horizon: int = 25, seed: int = 0, **fields: Any,
) -> TrialSpec:  # fmt: skip
    """Return a small trial with Runge-Kutta steps."""
    env_fields = {"horizon": horizon, "grid_points": SMALL_GRIDS[env], "integrator": "rk4"}
    own = "affine" if SYSTEMS[env].reads_inputs else "mlp"
    mapping = {
        "env": {"name": env, **env_fields, **fields},
        "policy": {"name": policy, **SMALL_SEARCHES.get(policy, {})},
        "model": {"name": model or MODELS.get(policy, own)},
        "learner": {"name": learner or LEARNERS.get(policy, "adam_window")},
        "seed": seed,
    }
    return TrialSpec.from_mapping(mapping)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
def test_errors_shrink_by_the_order_of_the_method(integrator: str, order: int) -> None:
    """On an oscillator, whose solution is known, halving dt divides the error by 2^order."""

    def end(n: int) -> np.ndarray:
        x = np.array([1.0, 0.0])
        for _ in range(n):
            x = next_state(integrator, lambda z: np.array([z[1], -z[0]]), x, 1.0 / n)
        return x

    truth = np.array([np.cos(1.0), -np.sin(1.0)])
    errors = [np.linalg.norm(end(n) - truth) for n in (20, 40)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_numpy_torch_and_the_kernel_take_the_same_step(name: str, integrator: str) -> None:
    system: System = SYSTEMS[name](integrator=integrator)
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal(system.n_states), rng.standard_normal(system.n_inputs)
    expected = next_state(integrator, lambda z: system.derivative(z, u), x, system.dt)
    plant, out = plant_of(system), np.empty(system.n_states)
    call(next_true_state, plant, plant.history[0], x, u, out)
    np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-15)

    def rate(z: torch.Tensor) -> torch.Tensor:
        return torch.tensor(system.derivative(z.numpy(), u))

    found = next_state(integrator, rate, torch.tensor(x), system.dt).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random", "oracle"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "quadrotor", "drifting_pendulum"])
def test_both_paths_agree(env: str, policy: str) -> None:
    spec = integrated(env, policy, horizon=15)
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.states, plain.states) < 1e-8
    assert relative_gap(fast.parameters, plain.parameters) < 1e-6
    assert relative_gap(fast.loss, plain.loss) < 1e-5


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm"])
def test_the_oracle_learns_the_parameters_themselves(env: str) -> None:
    """Taken for Euler steps, the same states leave an error of O(dt)."""
    spec = integrated(env, "oracle", horizon=200, noise=0.0)
    result = run_trial(spec)
    assert result.loss[-1] < 1e-5
    euler = run_trial(integrated(env, "oracle", horizon=200, noise=0.0, integrator="euler"))
    assert relative_gap(result.states, euler.states) > 1e-4
    wrong = recorded_samples(SYSTEMS[env](horizon=200), result.states, result.inputs)
    truth = spec.system.learned(wrong.states)
    right = recorded_samples(spec.system, result.states, result.inputs)
    gap, small = (
        float(np.abs(samples.accelerations - spec.system.learned(samples.states)).max())
        for samples in (wrong, right)
    )
    assert small < 0.1 * gap
    assert gap > 1e-3 * float(np.abs(truth).max())


def test_forecasts_take_the_steps_of_the_system() -> None:
    system = SYSTEMS["cartpole"](integrator="rk4", horizon=20)
    rng = np.random.default_rng(1)
    inputs = rng.standard_normal((3, 20, 1))
    states = np.tile(np.array(system.initial_state), (3, 1))
    expected = simulate(system, np.moveaxis(inputs, 0, 1))[1:]
    for forecast in (true_forecast(system), forecast_by_equations(system)):
        np.testing.assert_allclose(forecast(states, inputs), expected, rtol=1e-11, atol=1e-13)
    model = MLP(width=5)
    theta = model.initial_parameters(system, rng)
    compiled = model_forecast(system, model, theta)(states, inputs)

    def rate(z: np.ndarray, u: np.ndarray) -> np.ndarray:
        known = np.stack(
            np.broadcast_arrays(*system.known(tuple(z.T), tuple(u.T), system.parameters)), -1
        )
        known[:, list(system.learned_rows)] += model.predict(system, theta, z)
        return known

    x = states
    for t in range(20):
        x = next_state("rk4", lambda z, t=t: rate(z, inputs[:, t]), x, system.dt)
        np.testing.assert_allclose(compiled[t], x, rtol=1e-10, atol=1e-12)


def test_an_explorer_fed_the_states_of_a_trial_learns_what_it_learned() -> None:
    spec = integrated("cartpole", horizon=60)
    result = run_trial(spec)
    explorer = Explorer(spec.system)
    for x, following, u in zip(result.states, result.states[1:], result.inputs, strict=False):
        assert explorer.ask(x) == pytest.approx(u, abs=1e-12)
        explorer.tell(following)
    np.testing.assert_allclose(explorer.parameters, result.parameters, atol=1e-12)


@pytest.mark.parametrize("learner", ["adam", "adam_window"])
def test_a_reset_changes_no_sample_before_it(learner: str) -> None:
    """The state in which a plant starts anew takes the place of the one that was reached."""
    spec = integrated("pendulum", "random", horizon=40)
    explorers = [
        Explorer(spec.system, policy="random", learner=learner, path=path)
        for path in ("kernel", "reference")
    ]
    rng, x = np.random.default_rng(0), np.zeros(2)
    for k in range(40):
        x = rng.standard_normal(2) if k % 5 == 0 else x
        for explorer in explorers:
            if k % 5 == 0:
                explorer.reset()
            u = explorer.ask(x)
        x = next_state("rk4", lambda z, u=u: spec.system.derivative(z, u), x, 0.02)
        for explorer in explorers:
            explorer.tell(x)
    assert relative_gap(explorers[0].parameters, explorers[1].parameters) < 1e-7


def test_the_view_of_a_plugin_has_the_sampled_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example's learner of the tutorial means the same on both paths."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    mapping = integrated("pendulum", "random").to_mapping()
    own = {"_target_": "heavy_ball.HeavyBall"}
    spec = TrialSpec.from_mapping({**mapping, "learner": own})
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.parameters, plain.parameters) < 1e-10


def test_keys_of_stored_trials_stay() -> None:
    assert '"integrator"' not in TrialSpec.from_names("pendulum", "random").config_json
    assert '"integrator":"rk4"' in integrated("pendulum").config_json
    assert draw(integrated("pendulum")).noise.shape == (25, 2)


def test_a_plant_says_its_integrator() -> None:
    given: dict[str, Any] = {
        "states": {"angle": "rad", "rate": "rad/s"}, "inputs": {"u": "V"}, "dt": 0.01, "gamma": 1.0,
        "known": {"angle": "rate", "rate": "u"}, "learned": ["rate"], "angles": ["angle"],
        "box": {"rate": 1.0},
    }  # fmt: skip
    plant = Plant(**given, integrator="rk4")
    assert Plant.from_section(plant.to_section() | {"horizon": 10}).integrator == "rk4"
    assert "integrator" not in Plant(**given).to_section()
    with pytest.raises(
        SpecificationError, match=r"integrator 'rk5' is unknown: did you mean 'rk4'"
    ):
        Plant(**given, integrator="rk5")
