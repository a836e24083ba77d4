"""The extended Kalman filter as a learner: online Gauss-Newton steps on the newest sample.

======  ======================================================  =========
symbol  meaning                                                 shape
======  ======================================================  =========
θ       parameters of the model                                 q
J       ∂a_θ/∂θ at the newest state, before the learning step   r × q
e       y - a_θ(x), observed less modelled accelerations        r
M       information matrix, M₀ = λI                             q × q
ρ       variance of the observations
ζ       underweighting
f       forgetting factor
======  ======================================================  =========

References: S. Singhal and L. Wu, "Training multilayer perceptrons with the extended Kalman
algorithm" (1989); L. Ljung and T. Söderström, "Theory and practice of recursive identification"
(1983), for forgetting; L. Ngia and J. Sjöberg, "Efficient training of neural nets for nonlinear
adaptive filtering using a recursive Levenberg-Marquardt algorithm", IEEE Transactions on Signal
Processing 48 (2000), for the renewal of the prior, some diagonal entries of M at a time;
R. Zanetti, K. DeMars and R. Bishop, "Underweighting nonlinear measurements", Journal of Guidance,
Control, and Dynamics 33 (2010), for the underweighting, which is due to W. Lear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from dopt.declare.validated_fields import parameter
from dopt.learning.information_learner import InformationLearner


class Renewal(NamedTuple):
    """Part of the prior that is added back to M at each step while M fades.

    Attributes
    ----------
    entries : int
        Diagonal entries of M that are renewed at a step, k of them in turn: at step t those at
        (k t, ..., k t + k - 1) mod q.
    weight : float
        Number that is added to each of them.
    """

    entries: int
    weight: float


@dataclass(frozen=True, kw_only=True)
class ExtendedKalman(InformationLearner):
    """θ += K e with K = M⁻¹Jᵀ (ρI + J M⁻¹ Jᵀ)⁻¹, and M += JᵀJ/ρ.

    A sample enters M with the J that its learning step was taken with, hence at the parameters
    before that step, so that θ and M⁻¹ stay the mean and the covariance of one filter; for a model
    that is linear in θ this is recursive least squares. (With other learners the planner adds J at
    the parameters after the step, as the paper does.)

    With f < 1 the past fades, M_{t+1} = f M_t + D_t + JᵀJ/ρ. The diagonal D_t gives back what the
    prior loses, so that M never falls below λ/2 I: directions that nothing excites do not wind up,
    and the variance of no parameter exceeds 2/λ.

    With ζ > 0 a sample has the covariance R = ρI + ζ J M⁻¹ Jᵀ in place of ρI, M⁻¹ after what it
    has forgotten: K = M⁻¹Jᵀ (ρI + (1 + ζ) J M⁻¹ Jᵀ)⁻¹, and M += Jᵀ R⁻¹ J. The additional part
    stands for the error of the linearisation, which is large while the parameters are uncertain.
    However small λ is, a step then removes at most the share 1/(1 + ζ) of an error, and a variance
    along J falls by this share at most; once J M⁻¹ Jᵀ is far below ρ, it is the filter with ζ = 0.
    Plans count a sample as JᵀJ/ρ.

    Parameters
    ----------
    forgetting : float
        f, above 0 and at most 1: samples of 1/(1 - f) steps ago count 1/e. 1 forgets nothing.
    underweighting : float
        ζ, at least 0, which is the plain filter. With 2, and ρ = 0.1, the final loss hardly depends
        on λ.
    """

    name: ClassVar[str] = "ekf"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.kalman.learn"
    reads_inputs: ClassVar[bool] = True

    forgetting: float = parameter(1.0, bound="share")
    underweighting: float = parameter(0.0, bound="nonnegative", added=True)

    def renewal(self, n_parameters: int, regularization: float) -> Renewal:
        """Return what is given back of λI for q parameters.

        All entries have their turn within a period P with fᴾ ≥ 1/2, or at each step if f is less.
        With an entry at λ or above after its turn it is at fᴾλ or above before the next, to which
        λ(1 - fᴾ) is added.
        """
        if self.forgetting == 1.0:
            return Renewal(0, 0.0)
        longest = max(1, math.floor(math.log(0.5) / math.log(self.forgetting)))
        entries = math.ceil(n_parameters / longest)
        period = math.ceil(n_parameters / entries)
        return Renewal(entries, regularization * (1.0 - self.forgetting**period))

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:
        entries, weight = self.renewal(n_parameters, regularization)
        return self.noise_variance, self.forgetting, float(entries), weight, self.underweighting
