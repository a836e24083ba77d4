"""E-optimal exploration: the smallest variance of the least known parameter direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array
from dopt.policies.search import Search

_START_SEED = 1_712


@dataclass(frozen=True, kw_only=True)
class EOptimal(Search):
    """Maximise the smallest eigenvalue of M + JᵀJ, with J at x_t + dt f_θ(x_t, u).

    Its inverse is the largest eigenvalue of (M + JᵀJ)⁻¹. It is taken by Rayleigh and Ritz in a
    block Krylov space of M⁻¹, the same for all candidates, from r + 1 fixed vectors: a step adds r
    rows, so that an eigenvalue of larger multiplicity is seen to stay. As long as fewer than q rows
    are known that is 1/λ whatever the input: the criterion is blind, and chance decides.
    Reference: Y. Saad, "Numerical methods for large eigenvalue problems", 2nd ed., chapter 6.

    Parameters
    ----------
    subspace : int
        Dimensions of the Krylov space; with q of them the eigenvalue is exact.
    """

    name: ClassVar[str] = "e_optimal"
    compiled: ClassVar[bool] = True

    subspace: int = parameter(32, "dimensions", "positive")

    @property
    def score(self) -> str:
        return "e"

    def starts(self, n_parameters: int, n_learned: int) -> Array:
        """Return the vectors that span the Krylov space at first, (≤ r + 1, q)."""
        count = min(n_learned + 1, self.subspace, n_parameters)
        return np.random.default_rng(_START_SEED).standard_normal((count, n_parameters))
