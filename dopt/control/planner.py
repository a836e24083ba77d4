"""Cross-entropy planner: sample input sequences, keep the best, sample around them.

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
        """Return the best sequence that was tried, (H, m); ``start`` (H, m) is the first.

        Every round tries the mean of the elites of the one before as it is, and the last mean is
        tried as well. The first round is as wide as the ball of inputs, each component with
        standard deviation γ/√m.
        """
        best, lowest = start, np.inf
        mean, deviation = start, np.full(start.shape, self.gamma / np.sqrt(start.shape[1]))
        for _ in range(self.iterations):
            draws = rng.standard_normal((self.samples, *start.shape))
            draws[0] = 0.0
            U = within_ball(mean + deviation * draws, self.gamma)
            J = _costs(objective, U)
            elites = U[np.argsort(J, kind="stable")[: self.elites]]
            if J.min() < lowest:
                best, lowest = elites[0], J.min()
            mean, deviation = elites.mean(axis=0), elites.std(axis=0)
        return mean if _costs(objective, mean[None])[0] < lowest else best


def _costs(objective: Objective, inputs: Array) -> Array:
    J = objective(inputs)
    return np.where(np.isfinite(J), J, np.inf)


def within_ball(inputs: Array, radius: float) -> Array:
    """Return inputs, (..., m), those outside the ball of a radius moved onto it."""
    norms = np.linalg.norm(inputs, axis=-1, keepdims=True)
    shrunk: Array = inputs * np.minimum(1.0, radius / np.maximum(norms, 1e-300))
    return shrunk
