"""Fit and calibration of a learned model at states that its trial did not learn from.

The covariance of the parameters is that of the model's linearisation (Laplace approximation), with
the rows of all samples at the learned parameters.

======  ==========================================================  =====
symbol  meaning                                                     shape
======  ==========================================================  =====
θ       learned parameters                                          q
J       Jacobian of the accelerations in θ, at one state            r × q
ρ       noise variance that the trial assumes                       1
M       λρI + Σ JᵀJ over the samples                                q × q
s²      σ²/dt, variance of an observed acceleration                 1
V       s² J M⁻¹ Jᵀ, covariance of the accelerations at a state     r × r
======  ==========================================================  =====

Reference: D. MacKay, "A practical Bayesian framework for backpropagation networks", Neural
Computation 4 (1992), sections 2 and 3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.evaluation import evaluation_set
from dopt.samples import Samples, recorded_samples
from dopt.spec.information_form import Information, held_information
from dopt.spec.trial import TrialSpec

Array = npt.NDArray[np.float64]

HALF_WIDTH = 1.6448536269514722
"""Half of the width of an interval of 90 %, in standard deviations: the normal quantile of 0.95."""

_STEP = 1e-6
"""Change of a parameter in the central differences, beside 1 or its own size."""


class HeldOutFit(NamedTuple):
    """Fit of a model to accelerations, and coverage of its intervals.

    Attributes
    ----------
    r_squared : float
        1 - Σ e² / Σ (a - mean a)² over the states, mean over the learned components; 1 is a perfect
        fit, 0 that of the mean.
    covered : float
        Share of the true accelerations within their interval of 90 %, NaN without a covariance.
        Accelerations that depend on no parameter, as those at rest may, do not count.
    log_loss : float
        Mean negative log likelihood of the same accelerations, in nats; NaN without a covariance.
    """

    r_squared: float
    covered: float
    log_loss: float


class HeldOut(NamedTuple):
    """The fit on the evaluation grid and on the reachable set."""

    grid: HeldOutFit
    reachable: HeldOutFit


def held_out_fit(spec: TrialSpec, parameters: Array, states: Array, inputs: Array) -> HeldOut:
    """Return how well a learned model fits the evaluation points, without noise.

    Parameters
    ----------
    parameters : (q,)
        Learned parameters θ.
    states, inputs : (T + 1, d), (T, m)
        Of the trial: its samples give the covariance. There is none where the trial holds no
        information matrix, has several networks, no noise, or states that are measured with noise.
    """
    system, points = spec.system, evaluation_set(spec.system)
    truth = points.accelerations
    if len(system.history) > 1:
        truth = system.learned(points.states, system.horizon - 1, points.inputs)
    errors = spec.model.predict(system, parameters, points.states, points.inputs) - truth
    variances = np.full(truth.shape, np.nan)
    held = _information(spec)
    if held is not None:
        at = Samples(points.states, points.inputs, truth)
        samples = recorded_samples(system, states, inputs)
        variances = predicted_variances(spec, parameters, held, samples, at)
    parts = (slice(points.n_grid), slice(points.n_grid, None))
    return HeldOut(*(_fit(truth[one], errors[one], variances[one]) for one in parts))


def _information(spec: TrialSpec) -> Information | None:
    """Return λ and ρ of a trial whose model has a covariance, None of another."""
    system, model = spec.system, spec.model
    if model.n_members > 1 or model.structure == "conditioning" or system.n_measured:
        return None
    found = held_information(
        spec.policy, spec.learner, model.n_parameters(system), system.n_learned
    )
    return found if system.noise > 0.0 else None


def predicted_variances(
    spec: TrialSpec, parameters: Array, held: Information, samples: Samples, at: Samples
) -> Array:
    """Return the diagonals of V, (N, r), at N states; fixed parameters have no variance."""
    rows, points = (jacobian(spec, parameters, one) for one in (samples, at))
    flat = rows.reshape(-1, rows.shape[-1])
    matrix = flat.T @ flat + held.regularization * held.noise_variance * np.eye(flat.shape[1])
    whitened = np.linalg.solve(np.linalg.cholesky(matrix), points.reshape(-1, len(matrix)).T)
    squares: Array = np.sum(whitened**2, axis=0).reshape(points.shape[:-1])
    return spec.system.noise**2 / spec.system.dt * squares


def jacobian(spec: TrialSpec, parameters: Array, at: Samples) -> Array:
    """Return the derivatives, (N, r, q), of the accelerations in the free parameters.

    By central differences, for any model: of a network they are exact to about 1e-9.
    """
    system, model = spec.system, spec.model
    columns = []
    for i in range(len(parameters) - model.n_fixed_parameters(system)):
        step = np.zeros(len(parameters))
        step[i] = _STEP * max(1.0, abs(parameters[i]))
        above, below = (
            model.predict(system, moved, at.states, at.inputs)
            for moved in (parameters + step, parameters - step)
        )
        columns.append((above - below) / (2.0 * step[i]))
    return np.stack(columns, axis=-1)


def _fit(truth: Array, errors: Array, variances: Array) -> HeldOutFit:
    spread = np.sum((truth - truth.mean(axis=0)) ** 2, axis=0)
    r_squared = 1.0 - float(np.mean(np.sum(errors**2, axis=0) / spread))
    if np.isnan(variances).any():
        return HeldOutFit(r_squared, np.nan, np.nan)
    unsure = variances > 0.0
    e, v = errors[unsure], variances[unsure]
    covered = float(np.mean(np.abs(e) <= HALF_WIDTH * np.sqrt(v)))
    nats = 0.5 * (np.log(2.0 * np.pi * v) + e**2 / v)
    return HeldOutFit(r_squared, covered, float(np.mean(nats)))
