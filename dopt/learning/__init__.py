"""Learners of the model's parameters, and the registry that names them."""

from __future__ import annotations

from dopt.learning.base import InformationLearner, Learner
from dopt.learning.online import (
    Adam,
    AdamReplay,
    AdamRule,
    AdamWindow,
    Conditioning,
    ExtendedKalman,
    GaussNewton,
    JointKalman,
    RecursiveLeastSquares,
    SimulationError,
)

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
        SimulationError,
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
    "SimulationError",
]
