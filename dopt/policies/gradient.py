"""D-optimal exploration without linearisation: maximises Definition 1 by gradient ascent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.policies.base import InformationPolicy
from dopt.policies.candidate_policy import CandidatePolicy


@dataclass(frozen=True, kw_only=True)
class GradientDOptimal(CandidatePolicy, InformationPolicy):
    """Maximise G_D(u) = log det(M + J(x(u))ᵀ J(x(u))) on the sphere ‖u‖ = γ (Definition 1).

    All learned components count, and x(u) = x_t + dt f_θ(x_t, u) is exact. The value of each
    candidate is computed first; from the best of them, projected gradient ascent by automatic
    differentiation follows, along the great circle of the slope. With one input the candidates ±γ
    are the whole sphere, and nothing is left to ascend. Proposition 1 approximates this optimum in
    closed form; how far it falls short is measured by :mod:`benchmarks.linearisation_gap`.

    Parameters
    ----------
    candidates : int
        As of :class:`dopt.policies.candidate_policy.CandidatePolicy`.
    starts : int
        How many of them the ascent starts from.
    iterations : int
        Ascent steps from each start.
    """

    name: ClassVar[str] = "gradient"
    compiled: ClassVar[bool] = False

    starts: int = parameter(2, "inputs", "positive")
    iterations: int = parameter(4, "steps", "positive")

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"
