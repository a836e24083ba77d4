"""A learner that leaves the parameters to fits of the simulation beside an exploration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.learning.base import CustomLearner, Updater
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array


@dataclass(frozen=True, kw_only=True)
class SimulationError(CustomLearner):
    """Fit simulations to all that was measured (:func:`dopt.fit`), beside the exploration.

    A process of its own fits the unknown constants, delay and lag of a :class:`dopt.Plant` and a
    network of one hidden layer. What it finds comes into force between two steps; until the first
    fit the first guesses and the initial network are. It needs a few hundred rows without gaps.

    Parameters
    ----------
    first_rows : int
        Learned steps after which the first fit begins.
    growth : float
        New rows after which another fit begins, by the rows that the last one had.
    """

    name: ClassVar[str] = "simulation_error"
    compiled: ClassVar[bool] = True

    first_rows: int = parameter(150, "steps", "positive")
    growth: float = parameter(0.25, bound="positive")

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002  # nothing is drawn
        return _Unchanged()


class _Unchanged(Updater):
    def update(self, view: TrialView) -> Array:
        return view.parameters
