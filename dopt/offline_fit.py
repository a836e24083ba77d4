"""Samples of a trial, offline fits of its model to them, and the calibration of a learned model.

In the calibration, the covariance of the parameters follows from the linearised model (Laplace
approximation), with the rows of all samples at the learned parameters.

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

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.arguments import check_finite, rows_of, whole, within
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models.base import MLP, Model
from dopt.models.gaussian_process import GaussianProcess
from dopt.randomness import initial_weights
from dopt.spec.compatibility import Information
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array


@dataclass(frozen=True, eq=False)
class Samples:
    """States, inputs, and the accelerations that were observed there.

    Attributes
    ----------
    states : (N, d)
    inputs : (N, m)
        They count where the model reads inputs.
    accelerations : (N, r)
        Per second what the learned rows of the state are measured in, noise included.
    """

    states: Array
    inputs: Array
    accelerations: Array


def recorded_samples(system: System, states: Array, inputs: Array) -> Samples:
    """Return the samples of a trial, from its states (T + 1, d) and inputs (T, m).

    The observed accelerations are those that its learner was given: (x_{t+1} - x_t)/dt less the
    known part at x_t and u_t, in the learned rows. With the integrator of Runge and Kutta they are
    taken in the middle of the step, without what the learner's model adds to them. Where states are
    measured with noise they follow from the true states, which the learner was not given.

    Raises
    ------
    SpecificationError
        If the trial may have restarted on its way: its record does not say where.
    """
    if getattr(system, "restarts", False):
        raise SpecificationError(
            f"env.restarts of {system.name} is true, but the samples of a trial in one piece are "
            f"expected, as its record does not say where it restarted: leave such trials out."
        )
    return Samples(system.sampled_states(states), inputs, system.observed(states, inputs))


def sample_loss(spec: TrialSpec, states: Array, inputs: Array) -> float:
    """Return how much of the system the samples of a trial tell, whatever its own learner was.

    A Gaussian process is fitted to them, with the kernel that maximises its evidence. Its loss is
    the root mean square error over the evaluation grid at the last step, as of the trial itself.

    Parameters
    ----------
    spec : TrialSpec
        The trial; its policy, model and learner make no difference.
    states, inputs : (T + 1, d), (T, m)
        Of the trial.

    Raises
    ------
    SpecificationError
        If the trial diverged, or does not record the samples of a model of the states: its model
        reads inputs, its states are measured with noise, or it may have restarted.
    """
    process = TrialSpec(spec.config.process, spec.seed)
    samples = recorded_samples(spec.system, states, inputs)
    return fit_offline(process, samples.states, samples.accelerations).loss


RIDGE = 1e-4
"""Weight ρ of ‖θ - θ₀‖² beside the sum of squares.

It is the weight of a Gaussian prior around θ₀: the variance of an observed acceleration, σ²/dt, by
the variance of a parameter. In the paper's systems the former is 1e-5 to 5e-5, and a fit moves
the parameters of a network by 0.2 to 0.5, root mean square.
"""

MAX_STEPS = 3000
"""Steps after which a fit ends without having converged."""


@dataclass(frozen=True, eq=False)
class OfflineFit:
    """A model fitted to samples.

    Attributes
    ----------
    parameters : (q,)
        Parameters θ of the model.
    loss : float
        Root mean square error of its accelerations over the evaluation grid: the loss of a trial
        after the last step, in double precision.
    residual : float
        Root mean square error over the samples, noise included.
    steps : int
        Steps of the fit; for an ensemble the steps of the network that took most.
    converged : bool
        Whether further steps would have changed nothing that matters.
    """

    parameters: Array
    loss: float
    residual: float
    steps: int
    converged: bool


def fit_offline(
    spec: TrialSpec,
    states: npt.ArrayLike,
    accelerations: npt.ArrayLike,
    *,
    inputs: npt.ArrayLike | None = None,
    ridge: float = RIDGE,
    max_steps: int = MAX_STEPS,
) -> OfflineFit:
    """Fit the model of a trial to samples: minimise ‖y - a_θ(x)‖² + ρ‖θ - θ₀‖².

    θ₀ are the initial parameters of the trial, from which the fit of a network starts: damped
    Gauss-Newton (Levenberg-Marquardt) steps until the objective stays the same
    (:mod:`dopt.kernel.learners`). Each network of an ensemble is fitted by itself,
    from its own θ₀. A model that is linear in its parameters is solved for. Policy and learner of
    the trial make no difference.

    Parameters
    ----------
    spec : TrialSpec
        System, model and seed.
    states : (N, d)
        States x.
    accelerations : (N, r)
        Observed accelerations y, such as from :func:`dopt.offline_fit.recorded_samples`.
    inputs : (N, m), optional
        Inputs u, for a model that reads them.
    ridge : float
        ρ, which keeps what the samples do not decide near its initial value.
    max_steps : int
        Largest number of steps.

    Raises
    ------
    SpecificationError
        If the samples have other shapes or are not finite, the ridge or the number of steps is not
        positive, or the model is neither 'mlp', 'ensemble' nor linear in its parameters.
    """
    ridge, max_steps = within("ridge", ridge, math.inf), whole("max_steps", max_steps, 1)
    x = rows_of("states", states, spec.system.n_states)
    y = rows_of("accelerations", accelerations, spec.system.n_learned)
    u = None
    if spec.model.n_inputs_read(spec.system):
        if inputs is None:
            raise SpecificationError(
                f"model '{spec.model.name}' reads inputs, but none were given: give the input of "
                f"each sample."
            )
        u = rows_of("inputs", inputs, spec.system.n_inputs)
    given = {"accelerations": y, "states": x} | ({} if u is None else {"inputs": u})
    for what, values in given.items():
        check_finite(what, values)
        if len(values) != len(x) or not len(x):
            raise SpecificationError(
                f"there are {len(x)} states and {len(values)} {what}, but as many of both, and at "
                f"least one, are expected: give one row of each for every sample."
            )
    initial = initial_weights(spec)
    if is_network(spec.model):
        points = spec.model.points(spec.system, x, u)
        parameters, steps, converged = _fit_networks(spec, points, y, initial, ridge, max_steps)
    elif spec.model.structure == "least_squares":
        parameters, steps, converged = _solve(spec, x, u, y, initial, ridge), 1, True
    elif isinstance(spec.model, GaussianProcess):
        from dopt.kernel.evidence import fit_process

        parameters = fit_process(spec.model, spec.system, x, y, spec.seed)
        steps, converged = 1, True
    else:
        raise SpecificationError(
            f"model '{spec.model.name}' has no offline fit, but 'mlp', 'ensemble', "
            f"'gaussian_process', or a model that is linear in its parameters, is expected: choose "
            f"one of these."
        )
    residual = _root_mean_square(spec.model.predict(spec.system, parameters, x, u) - y)
    return OfflineFit(parameters, grid_loss(spec, parameters), residual, steps, converged)


def is_network(model: Model) -> bool:
    """Return True if a model is the kernel's network, or an ensemble of such networks."""
    return isinstance(model, MLP) and model.compiled


def grid_loss(spec: TrialSpec, parameters: Array) -> float:
    """Return the loss of parameters, (q,), on the evaluation grid at the last step."""
    return _root_mean_square(_errors(spec, parameters, evaluation_set(spec.system).n_grid)[1])


def _errors(spec: TrialSpec, parameters: Array, n: int) -> tuple[Array, Array]:
    """Return the truth of the last step at the first n evaluation points, and the errors there."""
    system, points = spec.system, evaluation_set(spec.system)
    states, inputs, truth = points.states[:n], points.inputs[:n], points.accelerations[:n]
    if len(system.history) > 1:
        truth = system.learned(states, system.horizon - 1, inputs)
    return truth, spec.model.predict(system, parameters, states, inputs) - truth


def _root_mean_square(errors: Array) -> float:
    """Return the root of the mean ‖error‖² over samples, (N, r)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _fit_networks(
    spec: TrialSpec, points: Array, accelerations: Array, initial: Array, ridge: float, most: int
) -> tuple[Array, int, bool]:
    """Return the parameters of all networks, the most steps of one, and whether all converged."""
    from dopt.kernel.from_spec import network_of
    from dopt.kernel.learners import Problem, fit
    from dopt.kernel.pointers import compiled_for, kind_of

    network = network_of(spec.system, spec.model)
    features = spec.model.featurize(spec.system, points)
    columns = (np.array(rows.T, order="C") for rows in (features, accelerations))
    given = Problem(network, initial, float(ridge), *columns)
    parameters = initial.reshape(spec.model.n_members, -1).copy()
    found: list[tuple[int, bool]] = []
    for theta in parameters:
        problem = given._replace(prior=theta.copy())
        # The machine code itself: called by its name, Numba would compile it again for its own type
        # of a tuple of equal numbers.
        code = compiled_for(fit, tuple(map(kind_of, (problem, theta, most))))
        found.append(code(problem, theta, most))
    steps, converged = zip(*found, strict=True)
    return parameters.ravel(), max(steps), all(converged)


def _solve(
    spec: TrialSpec,
    states: Array,
    inputs: Array | None,
    accelerations: Array,
    initial: Array,
    ridge: float,
) -> Array:
    """Return the minimum for a model linear in its parameters but the fixed ones, the last."""
    system, model = spec.system, spec.model
    n_free = len(initial) - model.n_fixed_parameters(system)
    start = model.predict(system, initial, states, inputs)
    units = initial + np.eye(n_free, len(initial))
    columns = [(model.predict(system, unit, states, inputs) - start).ravel() for unit in units]
    rows = np.concatenate([np.stack(columns, axis=-1), np.sqrt(ridge) * np.eye(n_free)])
    right = np.concatenate([(accelerations - start).ravel(), np.zeros(n_free)])
    theta = initial.copy()
    theta[:n_free] += np.linalg.lstsq(rows, right, rcond=None)[0]
    return theta


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
        fit, 0 a prediction of the mean.
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
        Of the trial: its samples give the covariance, NaN where the trial holds no
        information matrix, has several networks, no noise, or states that are measured with noise.
    """
    points = evaluation_set(spec.system)
    truth, errors = _errors(spec, parameters, len(points.states))
    variances = np.full(truth.shape, np.nan)
    held = _information(spec)
    if held is not None:
        at = Samples(points.states, points.inputs, truth)
        samples = recorded_samples(spec.system, states, inputs)
        variances = predicted_variances(spec, parameters, held, samples, at)
    parts = (slice(points.n_grid), slice(points.n_grid, None))
    return HeldOut(*(_fit(truth[one], errors[one], variances[one]) for one in parts))


def _information(spec: TrialSpec) -> Information | None:
    """Return λ and ρ of a trial whose model has a covariance, None of another."""
    system, model = spec.system, spec.model
    if model.n_members > 1 or model.structure == "conditioning" or system.n_measured:
        return None
    return spec.config.information if system.noise > 0.0 else None


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
