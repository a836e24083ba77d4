"""Learning steps in compiled code: Adam on a window of samples, or on some drawn from a buffer."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import Network, Rules, State
from dopt.kernel.compiler import compiled, contracted
from dopt.kernel.network import features_at, loss_gradient


@compiled
def remember(network: Network, rules: Rules, state: State, t: int, x: Any, target: Any) -> None:
    """Put the sample of time t into the ring of newest samples."""
    slot = t % rules.window
    phi = np.empty(network.sizes[0])
    features_at(network, x, phi)
    for i in range(phi.shape[0]):
        state.window_features[i, slot] = phi[i]
    for k in range(target.shape[0]):
        state.window_targets[k, slot] = target[k]


@compiled
def adam_step(
    network: Network, rules: Rules, state: State, t: int, buffers: Any, gradient: Any
) -> None:
    """Take Adam's step t + 1 on the newest samples, which the state's window holds."""
    hidden, deltas = buffers
    features, targets = state.window_features, state.window_targets
    if t + 1 < rules.window:
        features = features[:, : t + 1].copy()
        targets = targets[:, : t + 1].copy()
    loss_gradient(network, state.theta, features, targets, hidden, deltas, gradient)
    adam_update(rules, t, state.theta, state.moment_1, state.moment_2, gradient)


@compiled
def replay_steps(
    network: Network, rules: Rules, state: State, t: int, places: Any, buffers: Any, gradient: Any
) -> None:
    """Take Adam's steps of time t, one for each row of places in the buffer, (steps, batch)."""
    hidden, deltas = buffers
    features = np.empty((state.window_features.shape[0], rules.batch))
    targets = np.empty((state.window_targets.shape[0], rules.batch))
    for s in range(rules.steps):
        for j in range(rules.batch):
            place = places[s, j]
            for i in range(features.shape[0]):
                features[i, j] = state.window_features[i, place]
            for k in range(targets.shape[0]):
                targets[k, j] = state.window_targets[k, place]
        loss_gradient(network, state.theta, features, targets, hidden, deltas, gradient)
        step = t * rules.steps + s
        adam_update(rules, step, state.theta, state.moment_1, state.moment_2, gradient)


@contracted
def adam_update(
    rules: Rules, t: int, theta: Any, moment_1: Any, moment_2: Any, gradient: Any
) -> None:
    """Move θ, (q,), and the moments, (q,), along a gradient: step t + 1."""
    correction_1 = 1.0 - rules.beta_1 ** (t + 1)
    correction_2 = 1.0 - rules.beta_2 ** (t + 1)
    for i in range(gradient.shape[0]):
        g = gradient[i]
        moment_1[i] = rules.beta_1 * moment_1[i] + (1.0 - rules.beta_1) * g
        moment_2[i] = rules.beta_2 * moment_2[i] + (1.0 - rules.beta_2) * g * g
        deviation = np.sqrt(moment_2[i] / correction_2)
        theta[i] -= rules.learning_rate * (moment_1[i] / correction_1) / (deviation + rules.epsilon)
