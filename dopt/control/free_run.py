"""Free-run error: the error of a model that predicts many steps without measurements."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.control.prediction import Forecast, forecast_by_equations
from dopt.evaluation import evaluation_set
from dopt.policies.base import on_sphere
from dopt.systems.base import System

Array = npt.NDArray[np.float64]

STARTS = 256
"""Held-out states from which the predictions start, at most."""

HOLD_STEPS = 10
"""Steps for which a held-out input is held."""

_SEED = 20_230_201


@dataclass(frozen=True)
class HeldOut:
    """True trajectories that no trial learns from.

    Attributes
    ----------
    starts : (N, d)
        States of the reachable set (:func:`dopt.evaluation.reachable_states`).
    inputs : (N, n, m)
        Random inputs on the sphere ‖u‖ = γ, held for 10 steps.
    states : (n, N, d)
        True states after each step, without noise.
    """

    starts: Array
    inputs: Array
    states: Array


@functools.lru_cache(maxsize=16)
def held_out(system: System, steps: int) -> HeldOut:
    """Return the trajectories of n steps; a function of the system's parameters alone."""
    points = evaluation_set(system)
    reachable = points.states[points.n_grid :]  # in the order of time
    starts = reachable[:: -(-len(reachable) // STARTS)]
    rng = np.random.default_rng(_SEED)
    draws = rng.standard_normal((len(starts), -(-steps // HOLD_STEPS), system.n_inputs))
    inputs = np.repeat(on_sphere(draws, system.gamma), HOLD_STEPS, axis=1)[:, :steps]
    return HeldOut(starts, inputs, forecast_by_equations(system)(starts, inputs))


def free_run_error(system: System, forecast: Forecast, steps: int) -> float:
    """Return the relative root mean square error of predictions over 1 ... n steps.

    The squared error of each state component is divided by the mean square of its true change
    since the start, and the mean over the components is taken: 1 is the error of the prediction
    that nothing changes, 0 that of the true model. No unit. Infinite or NaN where the model's
    prediction overflows.
    """
    truth = held_out(system, steps)
    return relative_error(forecast(truth.starts, truth.inputs), truth.states, truth.starts)


def relative_error(predicted: Array, states: Array, starts: Array) -> float:
    """Return the error of predictions (H, N, d) of states (H, N, d), in units of their changes.

    The changes are those from the starts, (N, d); a component that never changes does not count.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.mean((predicted - states) ** 2, axis=(0, 1))
    changes = np.mean((states - starts) ** 2, axis=(0, 1))
    moved = changes > 0.0
    return float(np.sqrt(np.mean(errors[moved] / changes[moved])))
