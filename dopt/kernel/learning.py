"""Learning steps in compiled code: Adam on a window of samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import Network, Rules, State
from dopt.kernel.compiler import compiled
from dopt.kernel.network import loss_gradient


@compiled
def adam_step(
    network: Network, rules: Rules, state: State, t: int, buffers: Any, gradient: Any
) -> None:
    """Take Adam's step t + 1 on the newest samples, which the state's window holds."""
    n = min(t + 1, rules.window)
    hidden, outputs, deltas = buffers
    loss_gradient(
        network,
        state.theta,
        state.window_features[:n],
        state.window_targets[:n],
        hidden,
        outputs[:n],
        deltas,
        gradient,
    )
    correction_1 = 1.0 - rules.beta_1 ** (t + 1)
    correction_2 = 1.0 - rules.beta_2 ** (t + 1)
    for i in range(gradient.shape[0]):
        g = gradient[i]
        state.moment_1[i] = rules.beta_1 * state.moment_1[i] + (1.0 - rules.beta_1) * g
        state.moment_2[i] = rules.beta_2 * state.moment_2[i] + (1.0 - rules.beta_2) * g * g
        mean = state.moment_1[i] / correction_1
        deviation = np.sqrt(state.moment_2[i] / correction_2)
        state.theta[i] -= rules.learning_rate * mean / (deviation + rules.epsilon)
