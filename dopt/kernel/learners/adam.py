"""Adam in compiled code (:mod:`dopt.learning.adam`): newest samples, or a replay buffer.

Its numbers are the learning rate, β₁, β₂ and ε.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled
from dopt.kernel.model import model_point, sampled_state
from dopt.kernel.model_kinds import write_normal_equations
from dopt.kernel.network import features_at, loss_gradient
from dopt.kernel.structs import Network, Trial
from dopt.kernel.vectors import multiply_add
from dopt.types import Matrix, Vector


@compiled
def sampled_point(trial: Trial, t: int) -> Vector:
    """Return where the accelerations of step t were observed: a state, or a state and u_t."""
    state = sampled_state(trial.plant, trial.record.states, t)
    return model_point(trial.network, state, trial.state.estimate.inputs[t])


@compiled
def store_sample(
    network: Network, features: Matrix, targets: Matrix, t: int, x: Vector, target: Vector
) -> None:
    """Put the features of a point and the accelerations observed there, (r,), into a ring."""
    slot = t % features.shape[1]
    phi = np.empty(network.feature_kinds.shape[0])
    features_at(network, x, phi)
    for i in range(phi.shape[0]):
        features[i, slot] = phi[i]
    for k in range(target.shape[0]):
        targets[k, slot] = target[k]


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Take Adam's step t + 1 on the newest samples, which the state's window holds."""
    features, targets = trial.state.window_features, trial.state.window_targets
    store_sample(trial.network, features, targets, t, sampled_point(trial, t), target)
    if t + 1 < features.shape[1]:
        features = features[:, : t + 1].copy()
        targets = targets[:, : t + 1].copy()
    adam_step(trial, t, features, targets)


@compiled
def adam_step(trial: Trial, step: int, features: Matrix, targets: Matrix) -> None:
    """Take step ``step`` + 1 on a batch: features (p, n) and observed accelerations (r, n)."""
    network, state, scratch = trial.network, trial.state, trial.scratch
    theta, gradient = state.theta, scratch.gradient
    if network.kind == ModelKind.MLP:
        loss_gradient(network, theta, features, targets, scratch.hidden, scratch.deltas, gradient)
    else:
        normal = np.empty((theta.shape[0], theta.shape[0]))
        write_normal_equations(trial.plant, network, theta, features, targets, normal, gradient)
        gradient *= -2.0 / features.shape[1]
    adam_update(trial.algorithm.learner, step, theta, state.moment_1, state.moment_2, gradient)


@compiled
def adam_update(
    numbers: Vector, t: int, theta: Vector, moment_1: Vector, moment_2: Vector, gradient: Vector
) -> None:
    """Move θ, (q,), and the moments, (q,), along a gradient: step t + 1."""
    learning_rate, beta_1, beta_2, epsilon = numbers[0], numbers[1], numbers[2], numbers[3]
    correction_1, correction_2 = _sum_of_weights(beta_1, t + 1), _sum_of_weights(beta_2, t + 1)
    rest_1, rest_2, rate, scale = (
        1.0 - beta_1,
        1.0 - beta_2,
        learning_rate / correction_1,
        1.0 / correction_2,
    )
    for i in range(gradient.shape[0]):
        g = gradient[i]
        moment_1[i] = multiply_add(beta_1, moment_1[i], rest_1 * g)
        moment_2[i] = multiply_add(beta_2, moment_2[i], rest_2 * g * g)
        deviation = np.sqrt(moment_2[i] * scale)
        theta[i] -= rate * moment_1[i] / (deviation + epsilon)


@compiled
def _sum_of_weights(beta: float, n: int) -> float:
    """Return the sum of the weights that a moment of decay β gives to n gradients."""
    return float(1.0 - beta**n)


@compiled
def learn_from_replay(trial: Trial, t: int, target: Vector) -> None:
    """Take Adam's steps of time t, one for each row of places in the buffer, (steps, batch)."""
    state, places = trial.state, trial.randomness.replay[t]
    seen, observed = state.window_features, state.window_targets
    store_sample(trial.network, seen, observed, t, sampled_point(trial, t), target)
    steps, batch = places.shape
    features = np.empty((seen.shape[0], batch))
    targets = np.empty((observed.shape[0], batch))
    for s in range(steps):
        for j in range(batch):
            place = places[s, j]
            for i in range(features.shape[0]):
                features[i, j] = seen[i, place]
            for k in range(targets.shape[0]):
                targets[k, j] = observed[k, place]
        step = t * steps + s
        adam_step(trial, step, features, targets)
