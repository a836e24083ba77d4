"""Error that the noise of sensors leaves after a run, expected, beside the losses of trials.

A network is fitted to the truth, and the sensitivity of the states to its parameters follows from
the run alone. With the noise of the sensors it gives the information that the measurements hold,
hence, in linear approximation, the covariance of the best estimate of the parameters.

======  ==================================================================  =====
symbol  meaning                                                             shape
======  ==================================================================  =====
θ*      parameters fitted to the true accelerations on the evaluation grid  q
F       step x_{t+1} = F(x_t, u_t, θ) of the model                          d
Ψ_t     ∂x_t/∂θ, Ψ_{t+1} = (∂F/∂x) Ψ_t + ∂F/∂θ, Ψ_0 = 0                     d × q
C, R    output matrix, and the variances of its noise                       n × d
M       Λ + Σ_t (C Ψ_t)ᵀ R⁻¹ (C Ψ_t)                                        q × q
Λ       I / mean (θ* - θ_0)², a prior that knows how far θ* lies            q × q
======  ==================================================================  =====

The expected error is √(mean tr J M⁻¹ Jᵀ) over the grid, J the Jacobian of the accelerations. It
leaves out the noise of the process, which would raise it. Single trials may end below it.

Reference: H. Van Trees, "Detection, estimation, and modulation theory" I (1968), section 2.4.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import numpy.typing as npt

from benchmarks.rows import Row
from dopt.calibration import jacobian
from dopt.control.planning import predict
from dopt.evaluation import evaluation_set
from dopt.offline_fit import fit_offline
from dopt.randomness import initial_weights
from dopt.run import run_trial
from dopt.samples import Samples
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System

Array = npt.NDArray[np.float64]
Fields = Mapping[str, object]

ANGLE: Fields = {"measured_states": [0], "measurement_noise": [0.0174532925]}
"""The angle of the pendulum alone, with noise of 1°."""

PLANNED: Fields = {"name": "d_optimal", "regularization": 3.0}
INPUTS: Mapping[str, tuple[Fields, str, Fields]] = {
    "d_optimal, joint_ekf, angle": (PLANNED, "joint_ekf", ANGLE),
    "random, joint_ekf, angle": ({"name": "random"}, "joint_ekf", ANGLE),
    "d_optimal, gauss_newton, state": ({"name": "d_optimal"}, "gauss_newton", {}),
}
"""Policy, learner and what is measured in the trials whose inputs are judged, by name."""

_STEP = 1e-6


def sensitivities(spec: TrialSpec, parameters: Array, states: Array, inputs: Array) -> Array:
    """Return Ψ_1 ... Ψ_T, (T, d, q), along states (T + 1, d) under inputs (T, m)."""
    system, x = spec.system, states[:-1]

    def following(theta: Array, at: Array) -> Array:
        accelerations = functools.partial(spec.model.predict, system, theta)
        reached: Array = predict(system, accelerations, at, inputs[:, None])[0]
        return reached

    by_state = _derivatives(lambda move: following(parameters, x + move), x.shape[1])
    by_parameter = _derivatives(lambda move: following(parameters + move, x), len(parameters))
    found, psi = np.empty_like(by_parameter), np.zeros(by_parameter.shape[1:])
    for t, (A, B) in enumerate(zip(by_state, by_parameter, strict=True)):
        found[t] = psi = A @ psi + B
    return found


def _derivatives(function: Callable[[Array], Array], size: int) -> Array:
    """Return the derivatives of (T, d) values in a vector that is added, (T, d, size)."""
    moves = _STEP * np.eye(size)
    changes = np.stack([function(move) - function(-move) for move in moves], axis=-1)
    found: Array = changes / (2.0 * _STEP)
    return found


def expected_error(spec: TrialSpec, states: Array, inputs: Array) -> float:
    """Return the loss that the noise of the sensors leaves, of the best estimate.

    Parameters
    ----------
    spec : TrialSpec
        System with its sensors, and a model that is a network.
    states, inputs : (T + 1, d), (T, m)
        A run of the system; it may be that of another policy.
    """
    system, theta = spec.system, _nearest(spec)
    deviation = np.array(system.measurement_noise)
    outputs = system.output_rows @ sensitivities(spec, theta, states, inputs)
    rows = (outputs / deviation[:, None]).reshape(-1, len(theta))
    prior = np.mean((theta - initial_weights(spec)) ** 2)
    information = rows.T @ rows + np.eye(len(theta)) / prior
    J = jacobian(spec, theta, _truth(system))
    factor = np.linalg.cholesky(information)
    whitened = np.linalg.solve(factor, J.reshape(-1, len(theta)).T)
    return float(np.sqrt(np.sum(whitened**2) / len(J)))


@functools.lru_cache(maxsize=8)
def _nearest(spec: TrialSpec) -> Array:
    """Return θ*, (q,)."""
    at = _truth(spec.system)
    return fit_offline(spec, at.states, at.accelerations).parameters


def _truth(system: System) -> Samples:
    """Return the true accelerations on the evaluation grid."""
    points = evaluation_set(system)
    grid = slice(points.n_grid)
    return Samples(points.states[grid], points.inputs[grid], points.accelerations[grid])


def measured(name: str, seed: int) -> tuple[float, float]:
    """Return the final loss of a trial of ``INPUTS``, and the error expected at its inputs."""
    policy, learner, sensors = INPUTS[name]
    result = run_trial(_spec(policy, learner, sensors, seed))
    assert result.final_loss is not None, "the pendulum does not diverge"
    judged = _spec(PLANNED, "joint_ekf", ANGLE, seed)
    return result.final_loss, expected_error(judged, result.states, result.inputs)


def _spec(policy: Fields, learner: str, sensors: Fields, seed: int) -> TrialSpec:
    sections = {"policy": policy, "model": {"name": "mlp"}, "learner": {"name": learner}}
    return TrialSpec.from_mapping(
        {"env": {"name": "pendulum", **sensors}, **sections, "path": "kernel", "seed": seed}
    )


def measure(quick: bool) -> list[Row]:
    """Return final losses and expected errors, geometric means over the seeds."""
    return [row for name in INPUTS for row in _rows(name, 1 if quick else 100)]


def _rows(name: str, seeds: int) -> Iterator[Row]:
    losses = np.array([measured(name, seed) for seed in range(seeds)])
    for what, value in zip(("loss", "expected"), np.exp(np.log(losses).mean(axis=0)), strict=True):
        yield Row(f"{name}, {what}", float(value), "rad/s²", note=f"{seeds} trials")
