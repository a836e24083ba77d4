"""Recursive least squares in compiled code (:mod:`dopt.learning.least_squares`)."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.update import filter_step, model_rows
from dopt.kernel.learners.samples import sampled_point
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Take the least-squares step on the observed accelerations, (r,), and update M."""
    theta, covariance = trial.state.theta, trial.state.covariance
    residuals = np.empty(target.shape[0])
    rows = model_rows(trial.plant, trial.network, theta, sampled_point(trial, t), residuals)
    for k in range(target.shape[0]):
        residuals[k] = target[k] - residuals[k]
    filter_step(covariance, theta, rows, residuals)
