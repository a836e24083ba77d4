"""How the model learns online: by Adam, by recursive least squares, or by conditioning."""

from __future__ import annotations

from dopt.learning.adam import Adam, AdamWindow
from dopt.learning.base import Learner
from dopt.learning.conditioning import Conditioning
from dopt.learning.recursive_least_squares import RecursiveLeastSquares

LEARNERS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (Adam, AdamWindow, RecursiveLeastSquares, Conditioning)
}

__all__ = ["LEARNERS", "Adam", "AdamWindow", "Conditioning", "Learner", "RecursiveLeastSquares"]
