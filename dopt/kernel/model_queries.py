"""Answers of a running trial's model to plans and updates in numpy, in compiled code.

The parameters are those that the trial has at the moment; of an ensemble its first member's.
"""

from __future__ import annotations

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import called_from_python, copy_into
from dopt.kernel.held_trial import HeldTrial, trial_in
from dopt.kernel.integration import next_model_state
from dopt.kernel.model import (
    gradients_along_inputs,
    model_accelerations,
    parameter_gradients,
    rows_at,
)
from dopt.kernel.policies.prediction import input_columns
from dopt.types import Matrix, Stack, Vector


@called_from_python
def write_accelerations(held: HeldTrial, points: Matrix, out: Matrix) -> None:
    """Write a_θ, (N, r), at points, (N, ·)."""
    trial = trial_in(held)
    for n in range(points.shape[0]):
        model_accelerations(trial.plant, trial.network, trial.state.theta, points[n], out[n])


@called_from_python
def write_jacobian(held: HeldTrial, point: Matrix, out: Matrix) -> None:
    """Write ∂a_θ/∂θ, (r, q), at a point, (1, ·)."""
    trial = trial_in(held)
    rows = rows_at(trial.plant, trial.network, trial.state.theta, point)
    for k in range(rows.shape[0]):
        copy_into(rows[k], out[k])


@called_from_python
def write_jacobian_change(held: HeldTrial, point: Vector, directions: Matrix, out: Stack) -> None:
    """Write the derivative of ∂a_θ/∂θ along directions, (k, ·), of a point, (k, r, q)."""
    trial = trial_in(held)
    plant, network, theta = trial.plant, trial.network, trial.state.theta
    for i in range(out.shape[1]):
        if network.kind == ModelKind.MLP:
            rows = gradients_along_inputs(plant, network, theta, point, directions, i)
        else:
            rows = parameter_gradients(plant, network, theta, point, directions, i)
        for j in range(directions.shape[0]):
            copy_into(rows[1 + j], out[j, i])


@called_from_python
def write_following(held: HeldTrial, x: Vector, inputs: Matrix, out: Matrix) -> None:
    """Write the states, (N, d), that the model predicts after a state under inputs, (N, m)."""
    trial = trial_in(held)
    plant, theta = trial.plant, trial.state.theta
    for n in range(inputs.shape[0]):
        next_model_state(plant, trial.network, theta, x, inputs[n], plant.dt, out[n])


@called_from_python
def write_input_matrix(held: HeldTrial, x: Vector, out: Matrix) -> None:
    """Write Bᵀ = dt (∂known/∂u)ᵀ, (m, d), at a state."""
    columns = input_columns(trial_in(held).plant, x)
    for j in range(columns.shape[0]):
        copy_into(columns[j], out[j])
