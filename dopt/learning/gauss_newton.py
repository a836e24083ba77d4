"""Gauss-Newton steps on all samples.

======  ==========================================================  =========
symbol  meaning                                                     shape
======  ==========================================================  =========
θ, θ₀   parameters of the model, and the initial ones               q
J       ∂a_θ/∂θ at all states of the buffer and the parameters θ    N r × q
e       y - a_θ(x), observed less modelled accelerations            N r
M       information matrix λI + JᵀJ/ρ                               q × q
λ, ρ    regularisation, variance of the observations
======  ==========================================================  =========

References: A. Björck, "Numerical methods for least squares problems" (1996), for the damped
Gauss-Newton method; L. Ljung and T. Söderström, "Theory and practice of recursive identification"
(1983), for its recursive form, which is the step between two fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.learning.information_learner import InformationLearner


@dataclass(frozen=True, kw_only=True)
class GaussNewton(InformationLearner):
    """Fit all samples: minimise ‖e‖²/ρ + λ‖θ - θ₀‖² from the present θ on.

    A fit takes damped Gauss-Newton steps θ += s M⁻¹ (Jᵀe/ρ + λ(θ₀ - θ)): s is 1, or the first of
    1/2, 1/4, ... 1/64 at which the objective does not grow; where it grows at all of them, θ stays.
    M is then that of the last step: the rows of all samples in the buffer at the parameters before
    it. (With other learners M sums rows at the parameters of their own time.) Between two fits the
    newest sample is filtered (:class:`dopt.learning.ExtendedKalman`). A λ so small that rounding
    leaves M indefinite ends the trial as diverged.

    Parameters
    ----------
    capacity : int
        Number of newest samples that are fitted.
    refit_every : int
        Steps from one fit to the next.
    steps : int
        Gauss-Newton steps of a fit.
    """

    name: ClassVar[str] = "gauss_newton"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.gauss_newton.learn"
    reads_inputs: ClassVar[bool] = True

    capacity: int = parameter(10_000, "samples", "positive")
    refit_every: int = parameter(1, "steps", "positive")
    steps: int = parameter(1, "steps", "positive")

    def samples_kept(self, horizon: int) -> int:
        return min(self.capacity, horizon)

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # none depends on how many parameters there are
        return regularization, self.noise_variance, float(self.refit_every), float(self.steps)
