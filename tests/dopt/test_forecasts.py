"""Compiled forecasts are what the arrays of the reference say."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.assessment import model_forecast, true_forecast
from dopt.control.planning import forecast_by, forecast_by_equations
from dopt.evaluation import simulate
from dopt.models import MLP, Linear
from dopt.models.base import Model
from dopt.systems import SYSTEMS, Pendulum
from dopt.systems.base import System

STATES, STEPS = 7, 12
CHANGING = {"drifting_pendulum", "moving_star"}
"""Systems that a forecast takes to stay as they are at the start."""


def asked(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return random states about the start, (N, d), and inputs, (N, H, m)."""
    rng = np.random.default_rng(4)
    states = system.initial_state + 0.5 * rng.standard_normal((STATES, system.n_states))
    return states, rng.standard_normal((STATES, STEPS, system.n_inputs))


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_the_truth_is_that_of_the_first_step(name: str) -> None:
    system = SYSTEMS[name]()
    expected = forecast_by_equations(system)(*asked(system))
    np.testing.assert_allclose(true_forecast(system)(*asked(system)), expected, rtol=1e-12)


@pytest.mark.parametrize("name", sorted(SYSTEMS))
@pytest.mark.parametrize("model", [MLP(), MLP(width=5, depth=3), Linear()])
def test_a_model_is_rolled_as_its_predictions_say(name: str, model: Model) -> None:
    system = SYSTEMS[name]()
    rng = np.random.default_rng(1)
    parameters = rng.standard_normal(model.n_parameters(system))
    if isinstance(model, Linear):  # drags brake, and are small enough for the Euler map
        parameters = 0.01 * np.abs(parameters)
    expected = forecast_by(system, lambda x, u: model.predict(system, parameters, x, u))(
        *asked(system)
    )
    found = model_forecast(system, model, parameters)(*asked(system))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [one for one in sorted(SYSTEMS) if one not in CHANGING])
def test_forecasts_are_the_simulation_of_the_evaluation(name: str) -> None:
    system = SYSTEMS[name]()
    _, inputs = asked(system)
    starts = np.tile(system.initial_state, (STATES, 1))
    expected = simulate(system, inputs.swapaxes(0, 1))[1:]
    np.testing.assert_allclose(true_forecast(system)(starts, inputs), expected, rtol=1e-11)


def test_the_parameters_of_the_moment_are_kept() -> None:
    pendulum, model = Pendulum(), MLP()
    parameters = model.initial_parameters(pendulum, np.random.default_rng(0))
    forecast = model_forecast(pendulum, model, parameters)
    before = forecast(*asked(pendulum))
    parameters[:] = 0.0
    np.testing.assert_array_equal(forecast(*asked(pendulum)), before)


def test_numbers_that_overflow_are_not_finite() -> None:
    pendulum, model = Pendulum(), MLP()
    parameters = np.full(model.n_parameters(pendulum), 1e308)
    states, inputs = asked(pendulum)
    found = model_forecast(pendulum, model, parameters)(states, inputs)
    assert not np.any(np.isfinite(found[-1]))
