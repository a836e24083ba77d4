"""Online learners: Adam, least squares, Kalman filters, conditioning, fits beside a rig.

Adam takes one step per time step t on the mean over the samples of ‖a_θ(x) - y‖², with y the
observed accelerations (x_{t+1} - x_t)/dt less their known part: on the newest sample (Algorithm 1
as printed), on a window of recent samples, or on replay. Least squares is recursive, by
Gauss-Newton steps, or by Kalman filters:

======  ==================================================================  =========
symbol  meaning                                                             shape
======  ==================================================================  =========
θ, θ₀   parameters of the model, and the initial ones                       q
J       ∂a_θ/∂θ at the newest state; in a fit at the N states of the        r × q
        buffer, as N r rows
e       y - a_θ(x), observed less modelled accelerations                    r
M       information matrix, M₀ = λI; in a fit λI + JᵀJ/ρ                    q × q
ρ       variance of the observed accelerations
ζ, f    underweighting, forgetting factor
x̂       estimate of the state, in the joint filter                          d
A       ∂x_{t+1}/∂x_t of the model's step                                   d × d
P       covariance of x̂, given θ                                            d × d
Ψ       derivative of x̂ by θ                                                d × q
C       row of one measured state; its noise has the variance R             1 × d
s       variance C P Cᵀ + R of the innovation y - C x̂, given θ              1
======  ==================================================================  =========

References: D. Kingma and J. Ba, "Adam: a method for stochastic optimization" (2015); L.-J. Lin,
"Self-improving reactive agents based on reinforcement learning, planning and teaching", Machine
Learning 8 (1992), for minibatches of all samples; A. Björck, "Numerical methods for least squares
problems" (1996), for the damped Gauss-Newton method; L. Ljung and T. Söderström, "Theory and
practice of recursive identification" (1983), for its recursive form, which is the step between two
fits, and for forgetting; S. Singhal and L. Wu, "Training multilayer perceptrons with the extended
Kalman algorithm" (1989); L. Ngia and J. Sjöberg, "Efficient training of neural nets for nonlinear
adaptive filtering using a recursive Levenberg-Marquardt algorithm", IEEE Transactions on Signal
Processing 48 (2000), for the renewal of the prior, some diagonal entries of M at a time; R.
Zanetti, K. DeMars and R. Bishop, "Underweighting nonlinear measurements", Journal of Guidance,
Control, and Dynamics 33 (2010), for the underweighting, which is due to W. Lear; B. Friedland,
"Treatment of bias in recursive filtering", IEEE Transactions on Automatic Control 14 (1969), for
the filter in two parts; L. Ljung, "Asymptotic behavior of the extended Kalman filter as a parameter
estimator for linear systems", IEEE Transactions on Automatic Control 24 (1979), for why Ψ has to be
in it; L. Ljung, "System identification: theory for the user" (1999), for the fit by errors of
predictions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import parameter
from dopt.learning.base import CustomLearner, InformationLearner, Learner, Updater
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array

NEVER = 2**31
"""Steps that no trial has."""


@dataclass(frozen=True, kw_only=True)
class AdamRule(Learner):
    """Base of the learners that take Adam's steps.

    Parameters
    ----------
    learning_rate : float
        Step size η.
    beta_1, beta_2 : float
        Decay rates of the first and the second moment.
    epsilon : float
        Regulariser of the denominator.
    """

    learning_rate: float = parameter(2e-3, bound="positive")
    beta_1: float = parameter(0.9, bound="fraction")
    beta_2: float = parameter(0.999, bound="fraction")
    epsilon: float = parameter(1e-8, bound="positive")


@dataclass(frozen=True, kw_only=True)
class Adam(AdamRule):
    """One Adam step on the newest sample at each time step.

    Parameters
    ----------
    window : int
        Number of newest samples in the loss; while fewer have been seen, those.
    """

    name: ClassVar[str] = "adam"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.learn_newest"
    reads_inputs: ClassVar[bool] = True

    window: int = parameter(1, "samples", "positive")

    def samples_kept(self, horizon: int) -> int:  # noqa: ARG002  # the window has its own size
        return self.window

    def largest_batch(self) -> int:
        return self.window


@dataclass(frozen=True, kw_only=True)
class AdamWindow(Adam):
    """One Adam step on the newest 100 samples, as in the authors' released code."""

    name: ClassVar[str] = "adam_window"
    compiled: ClassVar[bool] = True

    learning_rate: float = parameter(1e-2, bound="positive")
    window: int = parameter(100, "samples", "positive")


@dataclass(frozen=True, kw_only=True)
class AdamReplay(AdamRule):
    """Some Adam steps at each time step, each on samples drawn from the buffer with replacement.

    The sample of time t takes place t mod ``capacity`` of the buffer, in which the oldest one was.

    Parameters
    ----------
    capacity : int
        Number of newest samples that the buffer holds.
    batch : int
        Samples of a minibatch.
    steps : int
        Minibatches, and Adam steps, at each time step.
    """

    name: ClassVar[str] = "adam_replay"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.learn_from_replay"
    reads_inputs: ClassVar[bool] = True

    learning_rate: float = parameter(3e-3, bound="positive")
    capacity: int = parameter(10_000, "samples", "positive")
    batch: int = parameter(100, "samples", "positive")
    steps: int = parameter(30, "steps", "positive")

    def samples_kept(self, horizon: int) -> int:
        return min(self.capacity, horizon)

    def largest_batch(self) -> int:
        return self.batch

    def places(self, horizon: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Draw the places of the buffer that the minibatches are made of, (T, steps, batch).

        At time t they are uniform over the min(t + 1, capacity) places that hold a sample.
        """
        filled = np.minimum(np.arange(1, horizon + 1), self.capacity)
        return rng.integers(filled[:, None, None], size=(horizon, self.steps, self.batch))


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
    kernel_function: ClassVar[str] = "dopt.kernel.learners.learn_recursively"
    reads_inputs: ClassVar[bool] = True
    updates_information: ClassVar[bool] = True
    structure: ClassVar[str] = "least_squares"

    regularization: float = parameter(1e-3, bound="positive")


@dataclass(frozen=True, kw_only=True)
class Conditioning(Learner):
    """The exact posterior given every sample seen, by a factor that grows by a row a step.

    It costs t² at step t in time and memory, the drawback that the paper names. Where the evidence
    chooses the kernel (:class:`dopt.models.GaussianProcess`), it is fitted again whenever the
    number of samples has grown by a factor.

    Parameters
    ----------
    first_rows : int
        Samples of the first fit of the evidence.
    growth : float
        New samples after which another fit begins, by the samples that the last one had.
    """

    name: ClassVar[str] = "conditioning"
    structure: ClassVar[str] = "conditioning"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.condition"

    first_rows: int = parameter(10, "samples", "positive", added=True)
    growth: float = parameter(0.25, bound="positive", added=True)

    def next_fit(self, samples: int) -> int:
        """Return with how many samples the fit after one with so many is due; 0: the first one."""
        return max(self.first_rows, math.ceil((1.0 + self.growth) * samples), samples + 1)


@dataclass(frozen=True, kw_only=True)
class GaussNewton(InformationLearner):
    """Fit all samples: minimise ‖e‖²/ρ + λ‖θ - θ₀‖² from the present θ on.

    A fit takes damped Gauss-Newton steps θ += s M⁻¹ (Jᵀe/ρ + λ(θ₀ - θ)): s is 1, or the first of
    1/2, 1/4, ... 1/64 at which the objective does not grow. Where it grows at all of them, because
    the model is far from linear over a long step along parameters that little is known of, θ stays,
    or M + μI takes the place of M, with the first of five μ at which the objective falls.
    M then belongs to the last step: the rows of all samples in the buffer at the parameters before
    it. (With other learners M sums rows at the parameters of their own time.) Between two fits the
    newest sample is filtered (:class:`dopt.learning.ExtendedKalman`). A λ so small that rounding
    leaves M indefinite ends the trial as diverged.

    Parameters
    ----------
    capacity : int
        Number of newest samples that are fitted.
    refit_every : int
        Steps from one fit to the next. With 0 samples are filtered alone, in 60 µs a step for 386
        parameters, and a process beside an exploration (:class:`dopt.Explorer`) fits all of them,
        again whenever there are a quarter more. What it finds replaces θ, and M goes on.
    steps : int
        Gauss-Newton steps of a fit.
    overshoot : str
        Where the objective grows at all shares, θ may "stay", step after step, or the step is to
        "damp". New explorations of a plant damp it.
    """

    name: ClassVar[str] = "gauss_newton"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.learn_fitted"
    reads_inputs: ClassVar[bool] = True

    capacity: int = parameter(10_000, "samples", "positive")
    first_rows: ClassVar[int] = 20
    growth: ClassVar[float] = 0.25

    refit_every: int = parameter(1, "steps", "nonnegative")
    steps: int = parameter(1, "steps", "positive")
    overshoot: str = parameter("stay", choices=("stay", "damp"), added=True)

    @property
    def fits_beside(self) -> bool:
        """Whether a process beside an exploration fits, and steps do not."""
        return self.refit_every == 0

    def samples_kept(self, horizon: int) -> int:
        return min(self.capacity, horizon)

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # none depends on how many parameters there are
        every = self.refit_every or NEVER
        fit = float(every), float(self.steps), float(self.overshoot == "damp")
        return regularization, self.noise_variance, *fit


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
    kernel_function: ClassVar[str] = "dopt.kernel.learners.learn_filtered"
    reads_inputs: ClassVar[bool] = True

    forgetting: float = parameter(1.0, bound="share")
    underweighting: float = parameter(0.0, bound="nonnegative", added=True)

    def renewal(self, n_parameters: int, regularization: float) -> tuple[int, float]:
        """Return to how many diagonal entries of M, for q parameters, what is given back of λI.

        They have k entries in turn: at step t those at (k t, ..., k t + k - 1) mod q.
        All entries have their turn within a period P with fᴾ ≥ 1/2, or at each step if f is less.
        With an entry at λ or above after its turn it is at fᴾλ or above before the next, to which
        λ(1 - fᴾ) is added.
        """
        if self.forgetting == 1.0:
            return 0, 0.0
        longest = max(1, math.floor(math.log(0.5) / math.log(self.forgetting)))
        entries = math.ceil(n_parameters / longest)
        period = math.ceil(n_parameters / entries)
        return entries, regularization * (1.0 - self.forgetting**period)

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:
        entries, weight = self.renewal(n_parameters, regularization)
        return self.noise_variance, self.forgetting, float(entries), weight, self.underweighting


@dataclass(frozen=True, kw_only=True)
class JointKalman(InformationLearner):
    """Estimate x and θ together, from measured states with noise (``env.measured_states``).

    The covariance of both is held in two parts: P, and ΨM⁻¹Ψᵀ, by which the error of θ adds to it.
    A step predicts x̂ with the model,

        P ← A P Aᵀ + dt² E (ρI + ζ J M⁻¹ Jᵀ) Eᵀ,    Ψ ← A Ψ + dt E J,

    and takes each measured state in with the gain K = P Cᵀ/s: M ← M + (CΨ)ᵀ(CΨ)/s, hence its
    rows are the output's Jacobian CΨ; θ ← θ + Δ with Δ = M⁻¹(CΨ)ᵀ e/s;
    Ψ ← Ψ - K CΨ; x̂ ← x̂ + K e + ΨΔ; P ← P - K Kᵀ s. The initial state is known.

    Plans of searches count a sample as JᵀJ/ρ, which is more than outputs tell; D-optimal inputs do
    not depend on such a factor.

    ζ stands for what the linearisation leaves out (:class:`dopt.learning.ExtendedKalman`).

    Every ``refit_every`` steps θ is fitted again to all that was measured: with the filter over x̂
    alone, damped Gauss-Newton steps lead to the minimum of Σ (e²/s + log s) + λ‖θ - θ₀‖², and x̂,
    P, Ψ and M are computed over the whole run at the θ found. The time of a fit grows with the
    number of steps. With ``noise="fitted"`` it then moves ρ by factors of 10^(1/4), two decades at
    most, as long as Σ (e²/s + log s) falls: to what is likeliest. One ρ stands for all
    accelerations.

    Units: 1/λ is the variance of an initial parameter; M has no other unit, as e has its variance.

    Parameters
    ----------
    underweighting : float
        ζ, at least 0.
    refit_every : int
        Steps from one fit to the next; with more than a trial has, there is no fit.
    steps : int
        Gauss-Newton steps of a fit. M belongs to a minimum: with fewer steps intervals are too
        narrow.
    noise : str
        Whether ρ stays as "given", or is "fitted" too, from ``noise_variance`` on.
    """

    name: ClassVar[str] = "joint_ekf"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.joint_kalman.learn"
    reads_inputs: ClassVar[bool] = True
    estimates_states: ClassVar[bool] = True

    regularization: float = parameter(3.0, bound="positive")
    noise_variance: float = parameter(0.1, bound="positive")
    underweighting: float = parameter(2.0, bound="nonnegative")
    refit_every: int = parameter(100, "steps", "positive")
    steps: int = parameter(12, "steps", "positive")
    noise: str = parameter("given", choices=("given", "fitted"), added=True)

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # none depends on how many parameters there are
        fit = float(self.refit_every), float(self.steps), float(self.noise == "fitted")
        return regularization, self.noise_variance, self.underweighting, *fit


@dataclass(frozen=True, kw_only=True)
class SimulationError(CustomLearner):
    """Fit simulations to all that was measured (:func:`dopt.fit`), beside the exploration.

    A process of its own fits the unknown constants, delay and lag of a :class:`dopt.Plant` and a
    network of one hidden layer. What it finds comes into force between two steps; until the first
    fit the first guesses and the initial network are. It needs a few hundred rows without gaps.

    Parameters
    ----------
    first_rows : int
        Learned steps after which the first fit begins.
    growth : float
        New rows after which another fit begins, by the rows that the last one had.
    """

    name: ClassVar[str] = "simulation_error"
    compiled: ClassVar[bool] = True

    first_rows: int = parameter(150, "steps", "positive")
    growth: float = parameter(0.25, bound="positive")

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002  # nothing is drawn
        return _Unchanged()


class _Unchanged(Updater):
    def update(self, view: TrialView) -> Array:
        return view.parameters
