"""Recursive least squares for models that are linear in their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.learning.base import Learner


@dataclass(frozen=True, kw_only=True)
class RecursiveLeastSquares(Learner):
    """θ += K (y - a_θ(x)), K = M⁻¹Jᵀ (I + J M⁻¹ Jᵀ)⁻¹, with the planner's own M.

    Started from M₀ = λI it is at every t the minimiser of λ‖θ‖² + Σ ‖J θ + offset - y‖² over all
    samples seen: ordinary least squares with a vanishing ridge λ (``policy.regularization``).
    """

    name: ClassVar[str] = "recursive_least_squares"
    structure: ClassVar[str] = "least_squares"
