"""Offline fit of the model of a trial: all samples at once, to convergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models.base import Model
from dopt.models.mlp import MLP
from dopt.randomness import initial_weights
from dopt.spec.trial import TrialSpec

Array = npt.NDArray[np.float64]

RIDGE = 1e-4
"""Weight ρ of ‖θ - θ₀‖² beside the sum of squares.

It is the weight of a Gaussian prior around θ₀: the variance of an observed acceleration, σ²/dt, by
that of a parameter. In the paper's systems the former is 1e-5 to 5e-5, and a fitted network moves
its parameters by 0.2 to 0.5, root mean square.
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
        Steps of the fit; of an ensemble those of the network that took most.
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
    (:mod:`dopt.kernel.offline_fit`). Each network of an ensemble is fitted by itself, from its own
    θ₀. A model that is linear in its parameters is solved for. Policy and learner of the trial make
    no difference.

    Parameters
    ----------
    spec : TrialSpec
        System, model and seed.
    states : (N, d)
        States x.
    accelerations : (N, r)
        Observed accelerations y, such as those of :func:`dopt.samples.recorded_samples`.
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
    if not (ridge > 0 and np.isfinite(ridge)):
        raise SpecificationError(
            f"ridge is {ridge}, but a number above 0 is expected: give for instance {RIDGE:g}."
        )
    if max_steps < 1:
        raise SpecificationError(
            f"max_steps is {max_steps}, but at least 1 is expected: give for instance {MAX_STEPS}."
        )
    x = _rows(states, spec.system.n_states, "states")
    y = _rows(accelerations, spec.system.n_learned, "accelerations")
    if len(x) != len(y) or not len(x):
        raise SpecificationError(
            f"there are {len(x)} states and {len(y)} accelerations, but as many of both, and at "
            f"least one, are expected: give one row of each for every sample."
        )
    u = None
    if spec.model.n_inputs_read(spec.system):
        if inputs is None:
            raise SpecificationError(
                f"model '{spec.model.name}' reads inputs, but none were given: give the input of "
                f"each sample."
            )
        u = _rows(inputs, spec.system.n_inputs, "inputs")
        if len(u) != len(x):
            raise SpecificationError(
                f"there are {len(x)} states and {len(u)} inputs, but as many of both are expected "
                f"for model '{spec.model.name}', which reads inputs: give the input of each sample."
            )
    initial = initial_weights(spec)
    if is_network(spec.model):
        points = spec.model.points(spec.system, x, u)
        parameters, steps, converged = _fit_networks(spec, points, y, initial, ridge, max_steps)
    elif spec.model.structure == "least_squares":
        parameters, steps, converged = _solve(spec, x, u, y, initial, ridge), 1, True
    else:
        raise SpecificationError(
            f"model '{spec.model.name}' has no offline fit, but 'mlp', 'ensemble', or a model that "
            f"is linear in its parameters, is expected: choose one of these."
        )
    residual = _root_mean_square(spec.model.predict(spec.system, parameters, x, u) - y)
    return OfflineFit(parameters, grid_loss(spec, parameters), residual, steps, converged)


def can_be_fitted(model: Model) -> bool:
    """Tell whether a model has an offline fit."""
    return is_network(model) or model.structure == "least_squares"


def is_network(model: Model) -> bool:
    """Tell whether a model is the network that the kernel knows, or several of them."""
    return isinstance(model, MLP) and model.compiled


def grid_loss(spec: TrialSpec, parameters: Array) -> float:
    """Return the loss of parameters, (q,), on the evaluation grid at the last step."""
    system, points = spec.system, evaluation_set(spec.system)
    states, inputs, truth = (
        rows[: points.n_grid] for rows in (points.states, points.inputs, points.accelerations)
    )
    if len(system.history) > 1:
        truth = system.learned(states, system.horizon - 1, inputs)
    return _root_mean_square(spec.model.predict(system, parameters, states, inputs) - truth)


def _rows(given: npt.ArrayLike, size: int, what: str) -> Array:
    rows = np.asarray(given, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != size:
        raise SpecificationError(
            f"{what} have the shape {rows.shape}, but (N, {size}) is expected: give one row for "
            f"each sample."
        )
    if not np.isfinite(rows).all():
        raise SpecificationError(
            f"{what} hold a number that is not finite, but finite ones are expected: leave out the "
            f"samples from a divergence on."
        )
    return rows


def _root_mean_square(errors: Array) -> float:
    """Return the root of the mean ‖error‖² over samples, (N, r)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _fit_networks(
    spec: TrialSpec, points: Array, accelerations: Array, initial: Array, ridge: float, most: int
) -> tuple[Array, int, bool]:
    """Return the parameters of all networks, the most steps of one, and whether all converged."""
    fits = [
        _fit_network(spec, points, accelerations, member, ridge, most)
        for member in initial.reshape(spec.model.n_members, -1)
    ]
    parameters, steps, converged = zip(*fits, strict=True)
    return np.concatenate(parameters), max(steps), all(converged)


def _fit_network(
    spec: TrialSpec, points: Array, accelerations: Array, initial: Array, ridge: float, most: int
) -> tuple[Array, int, bool]:
    from dopt.kernel.model_from_spec import network_of
    from dopt.kernel.offline_fit import Problem, fit
    from dopt.kernel.pointers import compiled_for, kind_of

    network, features = (
        network_of(spec.system, spec.model),
        spec.model.featurize(spec.system, points),
    )
    columns = (np.array(rows.T, order="C") for rows in (features, accelerations))
    problem, theta = Problem(network, initial, float(ridge), *columns), initial.copy()
    kinds = tuple(map(kind_of, (problem, theta, most)))
    # The machine code itself: called by its name, Numba would compile it anew for its own type of
    # a tuple of equal numbers.
    code: Any = compiled_for("offline_fit", fit, kinds)
    steps, converged = code(problem, theta, most)
    return theta, steps, bool(converged)


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
