"""Learners in compiled code: Adam, recursive learners, and fits to many samples.

Adam (:mod:`dopt.learning.online`), on the newest samples or a replay buffer: its numbers are the
learning rate, β₁, β₂ and ε.

Recursive learners (:mod:`dopt.learning.online`): recursive least squares; the extended
Kalman filter, whose numbers are ρ, the forgetting factor f, the count of diagonal entries of M
renewed at a step, what each gets back, and ζ; and conditioning of a Gaussian process.

Fits of a network to many samples in compiled code: in a trial, and to given samples.

In a trial (:mod:`dopt.learning.online`) the numbers are λ, ρ, the steps from one fit to the
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

from dopt.algorithm import NO_GROWTH, SMALLEST_SHARE, ModelKind
from dopt.kernel.compiler import called_from_python, compiled, copy_into, squared
from dopt.kernel.gaussian_process import add_sample
from dopt.kernel.linear_algebra import (
    append_row,
    factorize,
    quadratic_forms,
    rank_update,
    replaced,
    settle,
    solve,
    solve_columns,
    write_inverse,
)
from dopt.kernel.model import model_point, model_rows, sampled_state, write_normal_equations
from dopt.kernel.network import features_at, loss_gradient
from dopt.kernel.normal_equations import (
    errors_of,
    normal_equations,
    sum_of_squares,
    write_normal,
    write_products,
)
from dopt.kernel.structs import Covariance, Network, State, Trial
from dopt.kernel.vectors import LANES, add_multiple, inner, multiply_add
from dopt.types import Matrix, Vector

DAMPINGS = (1e-6, 1e-4, 1e-2, 1.0, 100.0)
"""Dampings that are tried, in units of the largest entry of the diagonal, where all shares fail."""


@compiled
def sampled_point(trial: Trial, t: int) -> Vector:
    """Return where the accelerations of step t were observed: a state, or a state and u_t."""
    state = sampled_state(trial.plant, trial.record.states, t)
    return model_point(trial.network, state, trial.state.estimate.inputs[t])


@compiled
def store_sample(
    network: Network, features: Matrix, targets: Matrix, t: int, x: Vector, target: Vector
) -> None:
    """Put the features of a point and the accelerations observed there, (r,), into a ring."""
    slot = t % features.shape[1]
    phi = np.empty(network.feature_kinds.shape[0])
    features_at(network, x, phi)
    copy_into(phi, features[:, slot])
    copy_into(target, targets[:, slot])


@compiled
def learn_newest(trial: Trial, t: int, target: Vector) -> None:
    """Take Adam's step t + 1 on the newest samples, which the state's window holds."""
    features, targets = trial.state.window_features, trial.state.window_targets
    store_sample(trial.network, features, targets, t, sampled_point(trial, t), target)
    if t + 1 < features.shape[1]:
        features = features[:, : t + 1].copy()
        targets = targets[:, : t + 1].copy()
    adam_step(trial, t, features, targets)


@compiled
def adam_step(trial: Trial, step: int, features: Matrix, targets: Matrix) -> None:
    """Take step ``step`` + 1 on a batch: features (p, n) and observed accelerations (r, n)."""
    network, state, scratch = trial.network, trial.state, trial.scratch
    theta, gradient = state.theta, scratch.gradient
    if network.kind == ModelKind.MLP:
        loss_gradient(network, theta, features, targets, scratch.hidden, scratch.deltas, gradient)
    else:
        normal = np.empty((theta.shape[0], theta.shape[0]))
        write_normal_equations(trial.plant, network, theta, features, targets, normal, gradient)
        gradient *= -2.0 / features.shape[1]
    numbers, moment_1, moment_2 = trial.algorithm.learner, state.moment_1, state.moment_2
    beta_1, beta_2, epsilon = numbers[1], numbers[2], numbers[3]
    rest_1, rest_2 = 1.0 - beta_1, 1.0 - beta_2
    # A moment of decay β gives to n gradients weights whose sum is 1 - βⁿ.
    rate = numbers[0] / float(1.0 - beta_1 ** (step + 1))
    scale = 1.0 / float(1.0 - beta_2 ** (step + 1))
    for i in range(gradient.shape[0]):
        g = gradient[i]
        moment_1[i] = multiply_add(beta_1, moment_1[i], rest_1 * g)
        moment_2[i] = multiply_add(beta_2, moment_2[i], rest_2 * g * g)
        deviation = np.sqrt(moment_2[i] * scale)
        theta[i] -= rate * moment_1[i] / (deviation + epsilon)


@compiled
def learn_from_replay(trial: Trial, t: int, target: Vector) -> None:
    """Take Adam's steps of time t, one for each row of places in the buffer, (steps, batch)."""
    state, places = trial.state, trial.randomness.replay[t]
    seen, observed = state.window_features, state.window_targets
    store_sample(trial.network, seen, observed, t, sampled_point(trial, t), target)
    steps, batch = places.shape
    features = np.empty((seen.shape[0], batch))
    targets = np.empty((observed.shape[0], batch))
    for s in range(steps):
        for j in range(batch):
            place = places[s, j]
            for i in range(features.shape[0]):
                features[i, j] = seen[i, place]
            for k in range(targets.shape[0]):
                targets[k, j] = observed[k, place]
        adam_step(trial, t * steps + s, features, targets)


@compiled
def filter_step(covariance: Covariance, theta: Vector, rows: Matrix, residuals: Vector) -> None:
    """Add JᵀJ to M for J, (r, q), and correct θ by the residuals, (r,), which are overwritten."""
    correction = rank_update(covariance, rows, residuals)
    for i in range(theta.shape[0]):
        theta[i] += correction[i]


@compiled
def forget(covariance: Covariance, forgetting: float, t: int, renewed: int, renewal: float) -> None:
    """Turn M⁻¹ into (f M + D)⁻¹ at step t (:class:`dopt.learning.ExtendedKalman`).

    D has the entry ``renewal`` at the next ``renewed`` diagonal places, in turn.
    """
    settle(covariance)
    upper, pending, q = covariance.upper, covariance.pending, covariance.size
    for i in range(q):
        row = upper[i, i - i % LANES :]
        for j in range(row.shape[0]):
            row[j] /= forgetting
    for k in range(covariance.n_pending[0]):
        for j in range(q):
            pending[k, j] /= np.sqrt(forgetting)
    column = np.empty(q)
    for n in range(renewed):
        i = (t * renewed + n) % q
        _read_column(covariance, i, column)
        factor = np.sqrt(renewal / (1.0 + renewal * column[i]))
        for j in range(q):
            column[j] *= factor
        append_row(covariance, column)


@compiled
def _read_column(covariance: Covariance, i: int, out: Vector) -> None:
    """Write column i of M⁻¹, (q,)."""
    upper, pending, q = covariance.upper, covariance.pending, covariance.size
    for j in range(out.shape[0]):
        out[j] = upper[min(i, j), max(i, j)]
    for k in range(covariance.n_pending[0]):
        add_multiple(out, -pending[k, i], pending[k, :q])


@compiled
def learn_recursively(trial: Trial, t: int, target: Vector) -> None:
    """Take the least-squares step on the observed accelerations, (r,), and update M."""
    rows, residuals = _newest_rows(trial, t, target)
    filter_step(trial.state.covariance, trial.state.theta, rows, residuals)


@compiled
def _newest_rows(trial: Trial, t: int, target: Vector) -> tuple[Matrix, Vector]:
    """Return J, (r, q), at the sample of step t, and what the model leaves of it, (r,)."""
    residuals, point = np.empty(target.shape[0]), sampled_point(trial, t)
    rows = model_rows(trial.plant, trial.network, trial.state.theta, point, residuals)
    for k in range(target.shape[0]):
        residuals[k] = target[k] - residuals[k]
    return rows, residuals


@compiled
def learn_filtered(trial: Trial, t: int, target: Vector) -> None:
    """Filter the observed accelerations, (r,): update θ and M."""
    numbers = trial.algorithm.learner
    filter_sample(trial, t, target, numbers[0], numbers[1], int(numbers[2]), numbers[3], numbers[4])


@compiled
def filter_sample(
    trial: Trial,
    t: int,
    target: Vector,
    noise_variance: float,
    forgetting: float,
    renewed: int,
    renewal: float,
    underweighting: float,
) -> None:
    """Update θ and M by the sample of step t, after M has faded by a factor."""
    covariance = trial.state.covariance
    rows, residuals = _newest_rows(trial, t, target)
    if forgetting < 1.0:
        forget(covariance, forgetting, t, renewed, renewal)
    if underweighting > 0.0:
        whiten(covariance, rows, residuals, noise_variance, underweighting)
    else:
        scale_by_noise(rows, residuals, noise_variance)
    filter_step(covariance, trial.state.theta, rows, residuals)


@compiled
def scale_by_noise(rows: Matrix, residuals: Vector, noise_variance: float) -> None:
    """Divide J, (r, q), and the residuals, (r,), by √ρ."""
    scale = 1.0 / np.sqrt(noise_variance)
    for k in range(rows.shape[0]):
        residuals[k] *= scale
        for i in range(rows.shape[1]):
            rows[k, i] *= scale


@compiled
def whiten(
    covariance: Covariance,
    rows: Matrix,
    residuals: Vector,
    noise_variance: float,
    underweighting: float,
) -> None:
    """Multiply J, (r, q), and the residuals, (r,), by L⁻¹, where L Lᵀ = ρI + ζ J M⁻¹ Jᵀ.

    The residuals are NaN, which ends the trial as diverged, where rounding has left no L.
    """
    L = quadratic_forms(covariance, rows, rows)
    for k in range(L.shape[0]):
        for i in range(L.shape[1]):
            L[k, i] = underweighting * L[k, i] + (noise_variance if i == k else 0.0)
    if not factorize(L):
        residuals[:] = np.nan
        return
    solve_columns(L, rows)
    solve_columns(L, residuals.reshape(-1, 1))


@compiled
def condition(trial: Trial, t: int, target: Vector) -> None:
    """Add the sample of step t, whose accelerations are (r,), to a Gaussian process."""
    x, posterior = sampled_state(trial.plant, trial.record.states, t), trial.state.posterior
    copy_into(x, posterior.newest_state)
    copy_into(target, posterior.newest_target)
    add_sample(trial.network, trial.state.theta, posterior, x, target)


@compiled
def learn_fitted(trial: Trial, t: int, target: Vector) -> None:
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
        definite = definite and take_step(trial, ridge, features, targets, factor, damped)
    if not (definite and _write_information(state, factor, noise_variance)):
        state.theta[:] = np.nan  # which ends the trial as diverged


@compiled
def _write_information(state: State, factor: Matrix, noise_variance: float) -> bool:
    """Write M⁻¹ and the factor of M, where they are held; return whether M⁻¹ is finite.

    Given is the factor of ρ M.
    """
    finite, covariance, upper = True, state.covariance, state.covariance.upper
    if state.factor.shape[0] > 0:
        state.factor[:] = factor / np.sqrt(noise_variance)
    if covariance.size > 0:
        finite = write_inverse(factor, upper)
        upper *= noise_variance
        replaced(covariance)
    return finite


@compiled
def take_step(
    trial: Trial, ridge: float, features: Matrix, targets: Matrix, factor: Matrix, damped: bool
) -> bool:
    """Take a shortened Gauss-Newton step to the minimum of ‖e‖² + ridge ‖θ - θ₀‖².

    ``features`` (p, N), ``targets`` (r, N), θ and θ₀ (q,). The Cholesky factor of JᵀJ + ridge I
    before the step is written, (q, q). False, and no step, where rounding has left it indefinite.
    Where the sum grows at all shares of the step, θ stays, or a damped step is taken.
    """
    plant, network, theta, prior = trial.plant, trial.network, trial.state.theta, trial.state.prior
    q = theta.shape[0]
    slope, before = np.empty(q), theta.copy()
    squares = write_normal(plant, network, theta, features, targets, factor, slope)
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
        after = sum_of_squares(plant, network, theta, features, targets)
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
            after = sum_of_squares(plant, network, theta, features, targets)
            if after + ridge * squared_distance(theta, prior) < squares:
                return True
    theta[:] = before
    return True


@compiled
def squared_distance(a: Vector, b: Vector) -> float:
    """Return ‖a - b‖²."""
    total = 0.0
    for i in range(a.shape[0]):
        total += squared(a[i] - b[i])
    return total


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
    """Write δ, (q,), and θ + δ + κ, (q,); return whether the step is worth a try.

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
