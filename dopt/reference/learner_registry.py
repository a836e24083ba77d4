"""The learner of a batch, by its model and its specification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dopt.learning import ExtendedKalman, RecursiveLeastSquares
from dopt.learning.base import Updated
from dopt.models import GaussianProcess
from dopt.reference.gaussian_process import Posterior
from dopt.reference.learning import (
    BatchLearner,
    KalmanLearner,
    LeastSquaresLearner,
    learner_for,
)
from dopt.reference.own import OwnLearner

if TYPE_CHECKING:
    from dopt.reference.lockstep import Lockstep


def batch_learner(batch: Lockstep) -> BatchLearner | KalmanLearner:
    """Return the learner of a batch; it writes into the parameters of the batch."""
    model, learner = batch.cell.model, batch.cell.learner
    if isinstance(model, GaussianProcess):
        return Posterior(batch.system, model, batch.theta, batch.points)
    if isinstance(learner, Updated):
        return OwnLearner(learner, batch)
    if isinstance(learner, ExtendedKalman):
        assert batch.held is not None
        return KalmanLearner(learner, batch.model, batch.theta, batch.held.regularization)
    if isinstance(learner, RecursiveLeastSquares):
        ridge = float(getattr(batch.cell.policy, "regularization", learner.regularization))
        return LeastSquaresLearner(batch.model, batch.theta, ridge, batch.n_learned)
    return learner_for(learner, batch.model, batch.theta, batch.replay)
