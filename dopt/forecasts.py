"""Forecasts by the true system or a model, in compiled code where the kernel supports them."""

from __future__ import annotations

from dopt.control.planning import Array, Forecast, forecast_by, forecast_by_equations
from dopt.models import MLP, Linear, Model
from dopt.systems.base import System


def true_forecast(system: System) -> Forecast:
    """Return the forecast by the system itself as it is at the first step, without noise."""
    if not system.compiled:
        return forecast_by_equations(system)
    from dopt.kernel import forecast

    return forecast.true_forecast(system)


def model_forecast(system: System, model: Model, parameters: Array) -> Forecast:
    """Return the forecast by a model with parameters (q,) in place of the true accelerations.

    In compiled code are those of networks and of the linear form of physics.
    """
    if not (system.compiled and model.compiled and isinstance(model, (MLP, Linear))):
        return forecast_by(system, lambda x, u: model.predict(system, parameters, x, u))
    from dopt.kernel import forecast

    return forecast.model_forecast(system, model, parameters)
