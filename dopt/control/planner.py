"""Planning by the cross-entropy method: sample inputs, keep the best, sample around them.

Reference: R. Rubinstein and D. Kroese, "The Cross-Entropy Method", Springer (2004), chapter 5.

======  =====================================================  =============
symbol  meaning                                                shape
======  =====================================================  =============
U       sampled input sequences                                N × H × m
J       their costs                                            N
μ, s    mean and standard deviation of the sampled sequences   H × m
======  =====================================================  =============
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

Objective = Callable[[Array], Array]
"""Costs (N,) of input sequences (N, H, m); one that is not finite counts as the worst."""


@dataclass(frozen=True)
class CrossEntropy:
    """A planner of input sequences with ‖u‖ ≤ ``gamma`` at every step.

    Attributes
    ----------
    gamma : float
        Bound γ of the norm of an input.
    samples, iterations, elites : int
        Sequences in a round, rounds, and sequences that the next round is sampled around.
    """

    gamma: float
    samples: int
    iterations: int
    elites: int

    def plan(self, objective: Objective, start: Array, rng: np.random.Generator) -> Array:
        """Return a sequence, (H, m), of low cost; ``start`` (H, m) is tried in the first round.

        Every round tries the mean of the elites of the one before as it is. The first is as wide
        as the ball of inputs, each component with standard deviation γ/√m.
        """
        mean, deviation = start, np.full(start.shape, self.gamma / np.sqrt(start.shape[1]))
        for _ in range(self.iterations):
            draws = rng.standard_normal((self.samples, *start.shape))
            draws[0] = 0.0
            U = within_ball(mean + deviation * draws, self.gamma)
            J = objective(U)
            J = np.where(np.isfinite(J), J, np.inf)
            best = U[np.argsort(J, kind="stable")[: self.elites]]
            mean, deviation = best.mean(axis=0), best.std(axis=0)
        return mean


def within_ball(inputs: Array, radius: float) -> Array:
    """Return inputs, (..., m), those outside the ball of a radius moved onto it."""
    norms = np.linalg.norm(inputs, axis=-1, keepdims=True)
    shrunk: Array = inputs * np.minimum(1.0, radius / np.maximum(norms, 1e-300))
    return shrunk
