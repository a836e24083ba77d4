"""Fits of a network to many samples in compiled code: in a trial, and to given samples.

In a trial (:mod:`dopt.learning.least_squares`) the numbers are λ, ρ, the steps from one fit to the
next, the Gauss-Newton steps of a fit, and whether one that overshoots is damped. To given samples
(:mod:`dopt.offline_fit`) a network is fitted by the method of Levenberg and Marquardt:

======  =====================================================================  =========
symbol  meaning                                                                shape
======  =====================================================================  =========
θ, θ₀   parameters of the network, and the initial ones                        q
e       y - a_θ(x), observed less modelled accelerations                       r × N
F       ‖e‖² + ρ‖θ - θ₀‖², which is minimised
δ       step: (JᵀJ + (ρ + μ) I) δ = Jᵀe + ρ (θ₀ - θ)                            q
κ       correction for curvature: (JᵀJ + (ρ + μ) I) κ = -½ Jᵀa'', with a'' the  q
        second derivative of a_θ(x) along δ
ρ, μ    ridge, and the damping that is adapted from step to step
======  =====================================================================  =========

References: K. Madsen, H. Nielsen and O. Tingleff, "Methods for non-linear least squares problems"
(2004), algorithm 3.16, for the damping; M. Transtrum and J. Sethna, "Improvements to the
Levenberg-Marquardt algorithm for nonlinear least-squares minimization" (2012, arXiv:1201.5885), for
the correction, the geodesic acceleration. With it a fit takes a third of the steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import DAMPINGS, NO_GROWTH, SMALLEST_SHARE, ModelKind
from dopt.kernel import model_kinds
from dopt.kernel.compiler import called_from_python, compiled, squared
from dopt.kernel.learners.adam import sampled_point, store_sample
from dopt.kernel.learners.kalman import filter_sample
from dopt.kernel.linear_algebra import factorize, replaced, solve, write_inverse
from dopt.kernel.normal_equations import errors_of, normal_equations, write_products
from dopt.kernel.structs import Network, Plant, State, Trial
from dopt.kernel.vectors import inner
from dopt.types import Matrix, Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Fit all samples, or filter the newest one between two fits."""
    numbers, state = trial.algorithm.learner, trial.state
    noise_variance, refit_every, steps = numbers[1], int(numbers[2]), int(numbers[3])
    seen, observed = state.window_features, state.window_targets
    store_sample(trial.network, seen, observed, t, sampled_point(trial, t), target)
    if t % refit_every != 0:
        filter_sample(trial, t, target, noise_variance, 1.0, 0, 0.0, 0.0)
        return
    n, q = min(t + 1, seen.shape[1]), state.theta.shape[0]
    features, targets = seen[:, :n].copy(), observed[:, :n].copy()
    ridge, factor = numbers[0] * noise_variance, np.empty((q, q))
    definite, damped = True, numbers[4] > 0.0
    for _ in range(steps):
        definite = definite and take_step(
            *(trial.plant, trial.network, state.theta, state.prior, ridge, features, targets),
            factor,
            damped,
        )
    if not (definite and _write_information(state, factor, noise_variance)):
        state.theta[:] = np.nan  # which ends the trial as diverged


@compiled
def _write_information(state: State, factor: Matrix, noise_variance: float) -> bool:
    """Write M⁻¹ and the factor of M, where they are held; tell whether M⁻¹ is finite.

    Given is the factor of ρ M.
    """
    finite, covariance = True, state.covariance
    if state.factor.shape[0] > 0:
        state.factor[:] = factor / np.sqrt(noise_variance)
    if covariance.size > 0:
        finite = write_inverse(factor, covariance.upper)
        _scale(covariance.upper, noise_variance)
        replaced(covariance)
    return finite


@compiled
def take_step(
    plant: Plant,
    network: Network,
    theta: Vector,
    prior: Vector,
    ridge: float,
    features: Matrix,
    targets: Matrix,
    factor: Matrix,
    damped: bool,
) -> bool:
    """Take a shortened Gauss-Newton step to the minimum of ‖e‖² + ridge ‖θ - θ₀‖².

    ``features`` (p, N), ``targets`` (r, N), θ and θ₀ (q,). The Cholesky factor of JᵀJ + ridge I
    before the step is written, (q, q). False, and no step, where rounding has left it indefinite.
    Where the sum grows at all shares of the step, θ stays, or a damped step is taken.
    """
    q = theta.shape[0]
    slope, before = np.empty(q), theta.copy()
    squares = _write_normal(plant, network, theta, features, targets, factor, slope)
    squares += ridge * squared_distance(theta, prior)
    for i in range(q):
        factor[i, i] += ridge
        slope[i] += ridge * (prior[i] - theta[i])
    normal = factor.copy() if damped else factor
    if not factorize(factor):
        return False
    step = slope.copy()
    solve(factor, step)
    share = 1.0
    while share >= SMALLEST_SHARE:
        for i in range(q):
            theta[i] = before[i] + share * step[i]
        after = _squared_error(plant, network, theta, features, targets)
        if after + ridge * squared_distance(theta, prior) <= squares * NO_GROWTH:
            return True
        share *= 0.5
    largest, short = np.diag(normal).max(), np.empty((q, q))
    for k in range(len(DAMPINGS) if damped else 0):
        short[:], step[:] = normal, slope
        for i in range(q):
            short[i, i] += DAMPINGS[k] * largest
        if factorize(short):
            solve(short, step)
            theta[:] = before + step
            after = _squared_error(plant, network, theta, features, targets)
            if after + ridge * squared_distance(theta, prior) < squares:
                return True
    theta[:] = before
    return True


@compiled
def _write_normal(
    plant: Plant,
    network: Network,
    theta: Vector,
    features: Matrix,
    targets: Matrix,
    normal: Matrix,
    slope: Vector,
) -> float:
    """Write JᵀJ, (q, q), and Jᵀe, (q,), of a model of any kind; return ‖e‖²."""
    if network.kind == ModelKind.MLP:
        return normal_equations(network, theta, features, targets, normal, slope)
    model_kinds.write_normal_equations(plant, network, theta, features, targets, normal, slope)
    return model_kinds.squared_error(plant, network, theta, features, targets)


@compiled
def _squared_error(
    plant: Plant, network: Network, theta: Vector, features: Matrix, targets: Matrix
) -> float:
    """Return ‖e‖² of a model of any kind."""
    if network.kind == ModelKind.MLP:
        return errors_of(network, theta, features, targets)[0]
    return model_kinds.squared_error(plant, network, theta, features, targets)


@compiled
def squared_distance(a: Vector, b: Vector) -> float:
    """Return ‖a - b‖²."""
    total = 0.0
    for i in range(a.shape[0]):
        total += squared(a[i] - b[i])
    return total


@compiled
def _scale(upper: Matrix, factor: float) -> None:
    """Multiply the upper triangle of a matrix, (q, q)."""
    for i in range(upper.shape[0]):
        for j in range(i, upper.shape[0]):
            upper[i, j] *= factor


FIRST_DAMPING = 1e-3
"""First μ, in units of the largest entry of the diagonal of JᵀJ + ρI."""

LARGEST_CORRECTION = 0.75
"""Largest ‖κ‖, in units of ‖δ‖, of a step that is tried."""

PROBE = 0.1
"""Part of δ over which the second derivative is taken by central differences."""

SMALL_FALL = 1e-7
"""Fall of F in a step, in units of F, that counts as none."""

SMALL_STEP = 1e-3
"""Length of a step, in units of ‖θ‖, that counts as none."""

ROUNDING = 1e-12
"""Length of a step, in units of ‖θ‖, below which rounding hides any fall of F."""


class Problem(NamedTuple):
    """Network, prior and samples of a fit."""

    network: Network
    prior: Vector  # (q,) θ₀
    ridge: float  # ρ
    features: Matrix  # (p, N)
    targets: Matrix  # (r, N) accelerations


@called_from_python
def fit(problem: Problem, theta: Vector, max_steps: int) -> tuple[int, bool]:
    """Fit θ, (q,), in place; return the number of steps and whether the fit has converged.

    Converged: F fell by less than ``SMALL_FALL`` in a step that was shorter than ``SMALL_STEP``, or
    a step was so short that rounding hides any fall. A step after which F would not be smaller is
    counted and not taken.
    """
    q = theta.shape[0]
    normal, factor = np.empty((q, q)), np.empty((q, q))
    slope, step, candidate = np.empty(q), np.empty(q), np.empty(q)
    value = _linearize(problem, theta, normal, slope)
    damping, growth = FIRST_DAMPING * np.diag(normal).max(), 2.0
    for done in range(1, max_steps + 1):
        fall = -1.0
        if _write_step(problem, theta, normal, slope, damping, factor, step, candidate):
            fall = value - _objective(problem, candidate)
        size = np.sqrt(inner(step, step) / inner(theta, theta))
        if fall > 0.0:
            theta[:] = candidate
            if fall <= SMALL_FALL * value and size <= SMALL_STEP:
                return done, True
            foreseen = inner(step, slope) + damping * inner(step, step)
            excess = 2.0 * fall / foreseen - 1.0
            damping *= max(1.0 / 3.0, 1.0 - excess * squared(excess))
            growth = 2.0
            value = _linearize(problem, theta, normal, slope)
        elif size <= ROUNDING:
            return done, True
        else:
            damping *= growth
            growth *= 2.0
    return max_steps, False


@compiled
def _linearize(problem: Problem, theta: Vector, normal: Matrix, slope: Vector) -> float:
    """Write JᵀJ + ρI, (q, q), and Jᵀe + ρ(θ₀ - θ), (q,); return F."""
    network, prior, ridge, features, targets = problem
    squares = normal_equations(network, theta, features, targets, normal, slope)
    for i in range(theta.shape[0]):
        normal[i, i] += ridge
        slope[i] += ridge * (prior[i] - theta[i])
    return squares + ridge * squared_distance(theta, prior)


@compiled
def _objective(problem: Problem, theta: Vector) -> float:
    squares = errors_of(problem.network, theta, problem.features, problem.targets)[0]
    return squares + problem.ridge * squared_distance(theta, problem.prior)


@compiled
def _write_step(
    problem: Problem,
    theta: Vector,
    normal: Matrix,
    slope: Vector,
    damping: float,
    factor: Matrix,
    step: Vector,
    candidate: Vector,
) -> bool:
    """Write δ, (q,), and θ + δ + κ, (q,); tell whether the step is worth a try.

    It is not where the factor of JᵀJ + (ρ + μ) I, (q, q), which is overwritten, is not definite, or
    where the correction is so long that the samples are not described by it.
    """
    factor[:], step[:] = normal, slope
    for i in range(step.shape[0]):
        factor[i, i] += damping
    if not factorize(factor):
        return False
    solve(factor, step)
    correction = candidate
    _write_curvature(problem, theta, step, correction)
    solve(factor, correction)
    longest = LARGEST_CORRECTION * np.sqrt(inner(step, step))
    short = bool(0.5 * np.sqrt(inner(correction, correction)) <= longest)
    for i in range(step.shape[0]):
        candidate[i] = theta[i] + step[i] + 0.5 * correction[i]
    return short


@compiled
def _write_curvature(problem: Problem, theta: Vector, step: Vector, out: Vector) -> None:
    """Write -Jᵀa'', (q,), of the second derivative of the model along a step."""
    network, _, _, features, targets = problem
    _, errors, hidden = errors_of(network, theta, features, targets)
    _, ahead, _ = errors_of(network, theta + PROBE * step, features, targets)
    _, behind, _ = errors_of(network, theta - PROBE * step, features, targets)
    bend = (ahead - 2.0 * errors + behind) / (PROBE * PROBE)
    write_products(network, theta, features, hidden, bend, out)
