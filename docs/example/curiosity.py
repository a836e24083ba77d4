"""A closed-loop policy of one's own: of some random inputs the one that leads somewhere new."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, CustomPolicy, Planner, on_sphere
from dopt.systems import System
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class Curiosity(CustomPolicy):
    """Take the candidate whose predicted next state is farthest from its nearest neighbour.

    Distances are those of the features, so that an angle and its full turn are the same place.

    Parameters
    ----------
    candidates : int
        Random inputs on the sphere ‖u‖ = γ that are compared.
    """

    name: ClassVar[str] = "curiosity"

    candidates: int = parameter(32, "inputs", "positive")

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        return _Planner(system, self.candidates, rng)


class _Planner(Planner):
    def __init__(self, system: System, candidates: int, rng: np.random.Generator) -> None:
        self._system, self._rng = system, rng
        self._shape = (candidates, system.n_inputs)
        self._seen: list[Array] = []

    def choose(self, view: TrialView) -> Array:
        inputs = on_sphere(self._rng.standard_normal(self._shape), self._system.gamma)
        reached = self._system.featurize(view.following(view.states[-1], inputs))
        distances = np.linalg.norm(reached[:, None] - np.array(self._seen)[None], axis=2)
        best: Array = inputs[np.argmax(distances.min(axis=1))]
        return best

    def observe(self, view: TrialView) -> None:
        """Remember where the step began."""
        self._seen.append(self._system.featurize(view.states[-2]))
