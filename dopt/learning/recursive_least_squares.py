"""Recursive least squares for models that are linear in their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.learning.base import Learner


@dataclass(frozen=True, kw_only=True)
class RecursiveLeastSquares(Learner):
    """θ += K (y - a_θ(x)), K = M⁻¹Jᵀ (I + J M⁻¹ Jᵀ)⁻¹, with the planner's own M.

    Started from M₀ = λI it is at every t the minimiser of λ‖θ‖² + Σ ‖J θ + offset - y‖² over all
    samples seen: ordinary least squares with a vanishing ridge λ.

    Parameters
    ----------
    regularization : float
        λ, unless the policy has one: a policy that plans by M shares it with the learner.
    """

    name: ClassVar[str] = "recursive_least_squares"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.least_squares.learn"
    reads_inputs: ClassVar[bool] = True
    updates_information: ClassVar[bool] = True
    structure: ClassVar[str] = "least_squares"

    regularization: float = parameter(1e-3, bound="positive")
