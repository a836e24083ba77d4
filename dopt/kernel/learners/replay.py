"""Adam on minibatches of a replay buffer in compiled code (:mod:`dopt.learning.adam`).

Its numbers are those of :mod:`dopt.kernel.learners.adam`.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.learners.adam import adam_step
from dopt.kernel.learners.samples import sampled_point, store_sample
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
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
