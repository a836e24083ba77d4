"""Exploration by the one-step information gain of all learned components, not linearised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.policies.search import Search


@dataclass(frozen=True, kw_only=True)
class Exact(Search):
    """Maximise log det(I + J M⁻¹ Jᵀ), the growth of log det M, with J at x_t + dt f_θ(x_t, u).

    The objective of Definition 1 for one step, which D-optimal exploration linearises for one
    component (Proposition 1), over candidate inputs. Reference: V. Fedorov, "Theory of optimal
    experiments" (1972).
    """

    name: ClassVar[str] = "exact"
    compiled: ClassVar[bool] = True

    @property
    def score(self) -> str:
        return "joint"
