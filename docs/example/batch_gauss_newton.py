"""A learner of one's own: a damped Gauss-Newton step on some of the samples seen so far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.learning.base import Array, CustomLearner, Updater
from dopt.systems import System
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class BatchGaussNewton(CustomLearner):
    """θ ← θ + Jᵀ(J Jᵀ + δ I)⁻¹(y - a_θ(x)), for the samples x, y that are drawn at a step.

    Parameters
    ----------
    batch : int
        Samples that are drawn without replacement from all that were seen.
    damping : float
        δ, which bounds the step where the samples say little about the parameters.
    """

    name: ClassVar[str] = "batch_gauss_newton"

    batch: int = parameter(8, "samples", "positive")
    damping: float = parameter(1.0, bound="positive")

    def updater(
        self,
        system: System,  # noqa: ARG002  # the view holds it
        rng: np.random.Generator,
    ) -> Updater:
        return _Updater(self.batch, self.damping, rng)


class _Updater(Updater):
    def __init__(self, batch: int, damping: float, rng: np.random.Generator) -> None:
        self._batch, self._damping, self._rng = batch, damping, rng

    def update(self, view: TrialView) -> Array:
        drawn = self._rng.choice(view.t, min(view.t, self._batch), replace=False)
        errors = (view.accelerations[drawn] - view.predict(view.sampled[drawn])).ravel()
        J = np.concatenate([view.jacobian(state) for state in view.sampled[drawn]])
        damped = J @ J.T + self._damping * np.eye(len(J))
        changed: Array = view.parameters + J.T @ np.linalg.solve(damped, errors)
        return changed
