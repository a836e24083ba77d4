"""Error of learned physical parameters against the true ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models.linear import Linear
from dopt.systems.base import System

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-9
"""Relative difference of two mean squares of regressors that counts as rounding."""


def true_parameters(system: System, step: int = 0, names: Sequence[str] = ()) -> Array:
    """Return the true values, (q,), of physical parameters at a step, in their units.

    Without ``names`` they are the system's ``linear_parameters``.

    Raises
    ------
    SpecificationError
        If it has none: its learned accelerations are not linear in unknown parameters.
    """
    if not (names or system.linear_parameters):
        raise SpecificationError(
            f"env '{system.name}' has no parameters that its accelerations are linear in, but a "
            f"parameter error needs some: choose another env."
        )
    row = system.history[min(step, len(system.history) - 1)]
    values = dict(zip(system.physical, row, strict=True))
    return np.array([values[name] for name in names or system.linear_parameters])


def parameter_error(
    system: System, parameters: npt.ArrayLike, step: int = 0, names: Sequence[str] = ()
) -> float:
    """Return ‖θ - θ*‖₂ for learned parameters θ, (q,), with θ* true at a step.

    They are those of the names, or without any those of the linear model.
    """
    return float(np.linalg.norm(np.asarray(parameters) - true_parameters(system, step, names)))


def loss_by_parameter_error(system: System) -> float:
    """Return c such that the loss of the linear model is c ‖θ - θ*‖₂ for every θ.

    The squared loss is (θ - θ*)ᵀ G (θ - θ*), with G the mean of ΨᵀΨ over the evaluation grid. It is
    a multiple of the squared parameter error if G = c² I.

    Raises
    ------
    SpecificationError
        If G is no multiple of the identity matrix, or the system changes with time.
    """
    q = len(true_parameters(system))
    points, model = evaluation_set(system), Linear()
    at = system.points(points.states, points.inputs)[: points.n_grid]
    offset = model.predict_at(system, np.zeros(q), at)
    regressors = np.stack([model.predict_at(system, unit, at) - offset for unit in np.eye(q)])
    G = np.einsum("inr,jnr->ij", regressors, regressors) / len(at)
    square = float(G[0, 0])
    if len(system.history) > 1 or not np.allclose(
        G, square * np.eye(q), rtol=0.0, atol=TOLERANCE * abs(square)
    ):
        raise SpecificationError(
            f"the loss of env '{system.name}' weighs its parameters differently, but a parameter "
            f"error follows from a loss that weighs all alike: run the trials again with "
            f"dopt.rerun and compare their parameters."
        )
    return float(np.sqrt(square))
