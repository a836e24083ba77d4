"""Extended Kalman filter over the state and the parameters, from what is measured of the state.

======  ==================================================================  =======
symbol  meaning                                                             shape
======  ==================================================================  =======
x̂, θ    estimates of the state and of the parameters                        d, q
A       ∂x_{t+1}/∂x_t of the model's step                                   d × d
J       ∂a_θ/∂θ at the estimate                                             r × q
P       covariance of x̂, given θ                                            d × d
Ψ       derivative of x̂ by θ                                                d × q
C       row of one measured state; its noise has the variance R             1 × d
e, s    innovation y - C x̂ and its variance C P Cᵀ + R, given θ             1
M       information matrix, M₀ = λI                                         q × q
ρ, ζ    variance of the accelerations, underweighting
======  ==================================================================  =======

References: B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
Control 14 (1969), for the filter in two parts; L. Ljung, "Asymptotic behavior of the extended
Kalman filter as a parameter estimator for linear systems", IEEE Transactions on Automatic Control
24 (1979), for why Ψ has to be in it; L. Ljung, "System identification: theory for the user" (1999),
for the fit by errors of predictions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.learning.information_learner import InformationLearner


@dataclass(frozen=True, kw_only=True)
class JointKalman(InformationLearner):
    """Estimate x and θ together, from measured states with noise (``env.measured_states``).

    The covariance of both is held in two parts: P, and ΨM⁻¹Ψᵀ, by which the error of θ adds to it.
    A step predicts x̂ with the model,

        P ← A P Aᵀ + dt² E (ρI + ζ J M⁻¹ Jᵀ) Eᵀ,    Ψ ← A Ψ + dt E J,

    and takes each measured state in with the gain K = P Cᵀ/s: M ← M + (CΨ)ᵀ(CΨ)/s, hence the
    information is that of the output's Jacobian CΨ; θ ← θ + Δ with Δ = M⁻¹(CΨ)ᵀ e/s;
    Ψ ← Ψ - K CΨ; x̂ ← x̂ + K e + ΨΔ; P ← P - K Kᵀ s. The initial state is known.

    Plans of searches count a sample as JᵀJ/ρ, which is more than outputs tell; D-optimal inputs do
    not depend on such a factor.

    ζ stands for what the linearisation leaves out (:class:`dopt.learning.ExtendedKalman`).

    Every ``refit_every`` steps θ is fitted anew to all that was measured: with the filter over x̂
    alone, damped Gauss-Newton steps lead to the minimum of Σ (e²/s + log s) + λ‖θ - θ₀‖², and x̂,
    P, Ψ and M are those of the whole run at the θ that is found. The time of a fit grows with the
    number of steps. With ``noise="fitted"`` it then moves ρ by factors of 10^(1/4), two decades at
    most, as long as Σ (e²/s + log s) falls: to what is likeliest. One ρ stands for all
    accelerations.

    Units: 1/λ is the variance of an initial parameter; M has no other unit, as e has its variance.

    Parameters
    ----------
    underweighting : float
        ζ, at least 0.
    refit_every : int
        Steps from one fit to the next; with more than a trial has there is none.
    steps : int
        Gauss-Newton steps of a fit.
    noise : str
        Whether ρ stays as "given", or is "fitted" too, from ``noise_variance`` on.
    """

    name: ClassVar[str] = "joint_ekf"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.joint_kalman.learn"
    reads_inputs: ClassVar[bool] = True
    estimates_states: ClassVar[bool] = True

    regularization: float = parameter(3.0, bound="positive")
    noise_variance: float = parameter(0.1, bound="positive")
    underweighting: float = parameter(2.0, bound="nonnegative")
    refit_every: int = parameter(100, "steps", "positive")
    steps: int = parameter(4, "steps", "positive")
    noise: str = parameter("given", choices=("given", "fitted"), added=True)

    @property
    def fits_noise(self) -> bool:
        """Whether a fit estimates ρ."""
        return self.noise == "fitted"

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # none depends on how many parameters there are
        fit = float(self.refit_every), float(self.steps), float(self.fits_noise)
        return regularization, self.noise_variance, self.underweighting, *fit
