"""Factory of the learner of a batch, from its specification and model."""

from __future__ import annotations

from torch import Tensor

from dopt.learning import ExtendedKalman, GaussNewton, JointKalman, RecursiveLeastSquares
from dopt.learning.base import CustomLearner
from dopt.models import GaussianProcess
from dopt.reference.custom_plugins import OwnLearner
from dopt.reference.gaussian_process import Posterior
from dopt.reference.joint_kalman import JointKalmanLearner
from dopt.reference.learning import (
    BatchLearner,
    GaussNewtonLearner,
    KalmanLearner,
    LeastSquaresLearner,
    learner_for,
)
from dopt.reference.sensors import BatchSensors
from dopt.reference.state import BatchState


def batch_learner(
    batch: BatchState, points: Tensor, sensors: BatchSensors | None
) -> BatchLearner | JointKalmanLearner:
    """Return the learner of a batch; it writes into the parameters of the batch.

    ``points``, (N, d), are the states at which the model is evaluated at each step; ``sensors``
    measure the states, unless all are known.
    """
    model, learner = batch.config.model, batch.config.learner
    if isinstance(model, GaussianProcess):
        return Posterior(batch.system, model, batch.theta, points)
    if isinstance(learner, CustomLearner):
        return OwnLearner(learner, batch)
    if isinstance(learner, ExtendedKalman | GaussNewton):
        assert batch.held is not None
        assert batch.information is not None
        shared = batch.learned, batch.theta, batch.information, batch.held.regularization
        if isinstance(learner, GaussNewton):
            return GaussNewtonLearner(learner, *shared)
        return KalmanLearner(learner, *shared)
    if isinstance(learner, JointKalman):
        assert batch.held is not None
        assert sensors is not None
        return JointKalmanLearner(learner, batch, sensors, batch.held.regularization)
    if isinstance(learner, RecursiveLeastSquares):
        ridge = float(getattr(batch.config.policy, "regularization", learner.regularization))
        return LeastSquaresLearner(batch.learned, batch.theta, ridge, batch.n_learned)
    return learner_for(learner, batch.model, batch.theta, batch.replay)
