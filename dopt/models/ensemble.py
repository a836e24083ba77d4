"""Ensemble of networks that differ in their initial parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.models.base import Array
from dopt.models.mlp import MLP
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Ensemble(MLP):
    """The mean of E networks (:class:`dopt.models.MLP`) with initial parameters of their own.

    The first member is the network of the same seed: it learns at each step and plans are made with
    it, so that the trial explores as with one network. The others take turns, one learns at each
    step, so that a step costs two learning steps whatever E is. Losses, predictions and control use
    the mean of all members, whose errors partly cancel. It goes with a learner that fits all
    samples anew at each step. The parameters are those of the members one after the other.
    Reference: B. Lakshminarayanan et al., "Simple and scalable predictive uncertainty
    estimation using deep ensembles" (2017).

    Parameters
    ----------
    members : int
        Number of networks E.
    """

    name: ClassVar[str] = "ensemble"
    compiled: ClassVar[bool] = True
    structure: ClassVar[str] = "ensemble"

    members: int = parameter(5, "networks", "positive")

    @property
    def n_members(self) -> int:
        return self.members

    def n_parameters(self, system: System) -> int:
        return self.members * super().n_parameters(system)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw the parameters of one member after the other, as :class:`dopt.models.MLP` does."""
        drawn = [super(Ensemble, self).initial_parameters(system, rng) for _ in range(self.members)]
        return np.concatenate(drawn)

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        """Return the mean of the members' accelerations, (N, r)."""
        members = parameters.reshape(self.members, -1)
        values = [super(Ensemble, self).predict_at(system, theta, points) for theta in members]
        mean: Array = np.mean(values, axis=0)
        return mean
