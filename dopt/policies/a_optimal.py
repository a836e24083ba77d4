"""A-optimal exploration: the smallest mean variance of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.policies.search import Search


@dataclass(frozen=True, kw_only=True)
class AOptimal(Search):
    """Maximise the decrease of tr M⁻¹ by the rows J at x_t + dt f_θ(x_t, u).

    With V = J M⁻¹ it is tr((I + V Jᵀ)⁻¹ V Vᵀ) (Woodbury identity). Reference: F. Pukelsheim,
    "Optimal design of experiments" (1993), chapter 6.
    """

    name: ClassVar[str] = "a_optimal"
    compiled: ClassVar[bool] = True

    @property
    def score(self) -> str:
        return "a"
