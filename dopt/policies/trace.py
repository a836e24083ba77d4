"""Exploration by the one-step predictive variance of all learned components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.policies.search import Search


@dataclass(frozen=True, kw_only=True)
class Trace(Search):
    """Maximise tr(J M⁻¹ Jᵀ), the sum of all components' variances, at x_t + dt f_θ(x_t, u).

    The first-order term of log det(I + J M⁻¹ Jᵀ). It also is the objective of Algorithm 2 summed
    over the components, without linearisation in u; :mod:`dopt.policies.trace_linearized` has that.
    """

    name: ClassVar[str] = "trace"
    compiled: ClassVar[bool] = True

    @property
    def score(self) -> str:
        return "trace"
