"""How the model learns online: Adam on recent samples, or recursive least squares."""

from __future__ import annotations

from dopt.learning.adam import Adam, AdamWindow
from dopt.learning.base import Learner
from dopt.learning.recursive_least_squares import RecursiveLeastSquares

LEARNERS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (Adam, AdamWindow, RecursiveLeastSquares)
}

__all__ = ["LEARNERS", "Adam", "AdamWindow", "Learner", "RecursiveLeastSquares"]
