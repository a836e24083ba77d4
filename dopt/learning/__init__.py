"""Learners of the model's parameters, one file for each, and the registry that names them."""

from __future__ import annotations

from dopt.learning.adam import Adam, AdamRule, AdamWindow
from dopt.learning.adam_replay import AdamReplay
from dopt.learning.base import Learner
from dopt.learning.conditioning import Conditioning
from dopt.learning.extended_kalman import ExtendedKalman
from dopt.learning.gauss_newton import GaussNewton
from dopt.learning.information_learner import InformationLearner
from dopt.learning.joint_kalman import JointKalman
from dopt.learning.recursive_least_squares import RecursiveLeastSquares

LEARNERS: dict[str, type[Learner]] = {
    learner.name: learner
    for learner in (
        Adam,
        AdamWindow,
        AdamReplay,
        RecursiveLeastSquares,
        ExtendedKalman,
        GaussNewton,
        JointKalman,
        Conditioning,
    )
}

__all__ = [
    "LEARNERS",
    "Adam",
    "AdamReplay",
    "AdamRule",
    "AdamWindow",
    "Conditioning",
    "ExtendedKalman",
    "GaussNewton",
    "InformationLearner",
    "JointKalman",
    "Learner",
    "RecursiveLeastSquares",
]
