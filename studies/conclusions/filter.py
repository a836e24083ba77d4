"""Coverage of the intervals of the filter over state and parameters, and what its noise leaves.

Angles and places are measured with noise, rates are not. A state's interval has the variance of
P + Ψ M⁻¹ Ψᵀ. What is predicted is the acceleration at the true state; its interval has the
variance ρ + g M⁻¹ gᵀ.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from dopt.kernel.joint_kalman import run_filter
from dopt.kernel.run import KernelTrial
from dopt.offline_fit import HALF_WIDTH, Samples, fit_offline, jacobian
from dopt.spec.trial import TrialSpec
from dopt.types import Matrix

STEPS = 500
SEEDS = (100, 120)
ANGLE, PLACE = 0.0174532925, 0.01
MEASURED: dict[str, dict[str, Any]] = {
    "pendulum": {"measured_states": [0], "measurement_noise": [ANGLE]},
    "cartpole": {"measured_states": [0, 2], "measurement_noise": [PLACE, ANGLE]},
    "arm": {"measured_states": [0, 2], "measurement_noise": [ANGLE, ANGLE]},
}
"""Places [m] and angles [rad], with noise of 1 cm and 1°."""

PARTS = {"early": range(10, 100, 10), "fitted": range(101, 111, 3), "late": range(200, 501, 20)}
"""Steps at which intervals are looked at: before the first fit, after it, and later."""

PRIORS = (10.0, 1.0, 0.1)
"""Factors of λ for what the noise leaves: a variance of the prior a tenth as large, and so on."""


class Cell(NamedTuple):
    """Trials that differ by their seed."""

    env: str
    policy: str
    regularization: float
    steps: int

    def spec(self, seed: int) -> TrialSpec:
        """Return one trial."""
        learner = {"name": "joint_ekf", "steps": self.steps}
        policy: dict[str, Any] = {"name": self.policy}
        shared = policy if self.policy == "d_optimal" else learner
        shared["regularization"] = self.regularization
        env = {"name": self.env, "horizon": STEPS, **MEASURED[self.env]}
        return TrialSpec.from_mapping(
            {"env": env, "policy": policy, "model": {"name": "mlp"}, "learner": learner}
            | {"seed": seed}
        )


def cells() -> list[list[Cell]]:
    """Return the cells: the prior of the experiments with short fits and long, and two wider."""
    kinds = ((3.0, 4), (3.0, 12), (1.0, 12), (0.3, 12))
    policies = ("d_optimal", "random")
    return [[Cell(env, policy, *kind) for policy in policies for kind in kinds] for env in MEASURED]


class Row(NamedTuple):
    """What is kept of a trial; NaN where there is nothing to say.

    Attributes
    ----------
    loss : float
        After the last step.
    early, fitted, late : float
        Mean of eᵀ S⁻¹ e / d over steps, for errors e of d states with the covariance S; 1 is right.
    early_states, fitted_states, late_states : float
        Share of the states within their interval of 90 %.
    early_predictions, fitted_predictions, late_predictions : float
        Share of the accelerations within theirs.
    left_narrow, left, left_wide : float
        Loss that the noise leaves on the pendulum, for a variance of the prior times .1, 1 and 10.
    """

    loss: float
    early: float
    early_states: float
    early_predictions: float
    fitted: float
    fitted_states: float
    fitted_predictions: float
    late: float
    late_states: float
    late_predictions: float
    left_narrow: float
    left: float
    left_wide: float


def row(cell: Cell, seed: int) -> Row:
    """Run a trial and measure it."""
    spec = cell.spec(seed)
    run = KernelTrial(spec)
    found: dict[int, tuple[float, float, float]] = {}
    for t in sorted({t for part in PARTS.values() for t in part}):
        run.advance(t)
        if run.diverged_at is not None:
            return Row(*[math.nan] * len(Row._fields))
        found[t] = _intervals(run, t)
    means = [np.mean([found[t] for t in part], axis=0) for part in PARTS.values()]
    loss = float(run.record.loss[-1])
    asked = cell.env == "pendulum" and cell == cells()[0][0 if cell.policy == "d_optimal" else 4]
    left = noise_leaves(run, cell.regularization) if asked else [math.nan] * len(PRIORS)
    return Row(loss, *np.concatenate(means).tolist(), *left)


def _intervals(run: KernelTrial, t: int) -> tuple[float, float, float]:
    """Return eᵀ S⁻¹ e / d, and the shares of states and accelerations within their intervals."""
    state, x = run.trial.state, run.record.true_states[t]
    error, psi = x - run.record.states[t], state.estimate.sensitivity
    inverse = inverse_information(run)
    S = state.estimate.covariance + psi @ inverse @ psi.T
    weighted = float(error @ np.linalg.solve(S, error)) / len(error)
    within = np.abs(error) <= HALF_WIDTH * np.sqrt(np.diag(S))
    system, model = run.spec.system, run.spec.model
    truth = system.learned(x[None], t)
    sample = Samples(x[None], np.zeros((1, system.n_inputs)), truth)
    g = jacobian(run.spec, run.parameters, sample)[0]
    variances = state.estimate.noise_variance[0] + np.diag(g @ inverse @ g.T)
    missed = model.predict(system, run.parameters, x[None]) - truth
    known = np.abs(missed[0]) <= HALF_WIDTH * np.sqrt(variances)
    return weighted, float(within.mean()), float(known.mean())


def inverse_information(run: KernelTrial) -> Matrix:
    """Return M⁻¹, (q, q)."""
    held = run.trial.state.covariance
    upper = np.triu(held.upper[: held.size, : held.size])
    waiting = held.pending[: int(held.n_pending[0]), : held.size]
    inverse: Matrix = upper + np.triu(upper, 1).T - waiting.T @ waiting
    return inverse


def noise_leaves(run: KernelTrial, regularization: float) -> list[float]:
    """Return losses expected of the best estimate from a trial's outputs, one for each prior.

    In linear approximation around a network fitted to the truth on the grid, with the variance
    σ²/dt of the accelerations. The trial's parameters are overwritten.
    """
    spec, n = run.spec, len(run.record.inputs)
    grid = spec.system.grid()
    truth = spec.system.learned(grid, STEPS - 1)
    theta = fit_offline(spec, grid, truth, max_steps=100).parameters
    run.trial.state.theta[:] = theta
    run.trial.state.estimate.noise_variance[0] = spec.system.noise**2 / spec.system.dt
    outputs = n * len(spec.system.output_rows)
    rows, errors = np.empty((outputs, len(theta))), np.empty(outputs)
    run_filter(run.trial, n, rows, errors)
    at = Samples(grid, np.zeros((len(grid), spec.system.n_inputs)), truth)
    J = jacobian(spec, theta, at).reshape(-1, len(theta))
    left = []
    for factor in PRIORS:
        M = rows.T @ rows + factor * regularization * np.eye(len(theta))
        whitened = np.linalg.solve(np.linalg.cholesky(M), J.T)
        left.append(math.sqrt(float(np.sum(whitened**2)) / len(grid)))
    return left
