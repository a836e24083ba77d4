"""One time step of the truth or of a model with a held input, in compiled code.

Either is taken in stages: one for the Euler map, four for the method of Runge and Kutta. Twin of
:mod:`dopt.systems.base`.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS, Integrator
from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.model import model_accelerations
from dopt.kernel.points import model_point, plant_point
from dopt.kernel.structs import Network, Plant
from dopt.types import Vector


@compiled
def n_stages(plant: Plant) -> int:
    """Return how often a step asks for the derivative."""
    return 1 if plant.integrator == Integrator.EULER else 4


@compiled
def write_rate(plant: Plant, x: Vector, u: Vector, accelerations: Vector, rate: Vector) -> None:
    """Write known(x, u) + E a, (d,), given the accelerations, (r,)."""
    plant.known(x, u, plant.parameters, rate)
    for k in range(accelerations.shape[0]):
        rate[plant.learned_rows[k]] += accelerations[k]


@compiled
def add_stage(
    plant: Plant, stage: int, dt: float, x: Vector, rate: Vector, total: Vector, at: Vector
) -> None:
    """Add the derivative of a stage to the mean, (d,), and write where the next one is asked for.

    After the last stage that is the state dt seconds after x.
    """
    if plant.integrator == Integrator.EULER:
        for i in range(x.shape[0]):
            total[i] = rate[i]
            at[i] = x[i] + dt * rate[i]
        return
    weight = RUNGE_KUTTA_WEIGHTS[stage]
    for i in range(x.shape[0]):
        total[i] = weight * rate[i] + (total[i] if stage > 0 else 0.0)
        if stage < 3:
            at[i] = x[i] + RUNGE_KUTTA_SHARES[stage] * dt * rate[i]
        else:
            at[i] = x[i] + dt * total[i]


@compiled
def next_true_state(
    plant: Plant, parameters: Vector, x: Vector, u: Vector, following: Vector
) -> None:
    """Write the state that follows with the true accelerations."""
    rate, total = np.empty(x.shape[0]), np.empty(x.shape[0])
    accelerations = np.empty(plant.learned_rows.shape[0])
    copy_into(x, following)
    for stage in range(n_stages(plant)):
        plant.accelerations(plant_point(plant, following, u), parameters, accelerations)
        write_rate(plant, following, u, accelerations, rate)
        add_stage(plant, stage, plant.dt, x, rate, total, following)


@compiled
def next_model_state(
    plant: Plant,
    network: Network,
    theta: Vector,
    x: Vector,
    u: Vector,
    dt: float,
    following: Vector,
) -> None:
    """Write the state that follows dt seconds later with the accelerations of the model."""
    rate, total = np.empty(x.shape[0]), np.empty(x.shape[0])
    accelerations = np.empty(plant.learned_rows.shape[0])
    copy_into(x, following)
    for stage in range(n_stages(plant)):
        model_accelerations(
            plant, network, theta, model_point(network, following, u), accelerations
        )
        write_rate(plant, following, u, accelerations, rate)
        add_stage(plant, stage, dt, x, rate, total, following)
