"""Base class of the learners whose step needs the information matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.learning.base import Learner


@dataclass(frozen=True, kw_only=True)
class InformationLearner(Learner):
    """A learner that updates θ and the information matrix M together.

    There is one information matrix. With a policy that plans by M the learner takes that of the
    policy, with its λ; with any other it holds one of its own. M is held as a q × q matrix.

    Parameters
    ----------
    regularization : float
        λ of a learner with a matrix of its own; with ρ = 1 it is the ratio of the variance of the
        observations to that of the initial parameters.
    noise_variance : float
        ρ, in the units in which the parameters have the variance 1/λ.
    """

    updates_information: ClassVar[bool] = True

    regularization: float = parameter(1e-3, bound="positive")
    noise_variance: float = parameter(1.0, bound="positive")
