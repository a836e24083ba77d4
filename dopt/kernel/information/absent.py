"""Functions of a trial whose policy has no information matrix, or whose learner updates it."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Leave M as it is."""


@compiled
def planning_forms(
    plant: Plant,  # noqa: ARG001
    network: Network,  # noqa: ARG001
    state: State,  # noqa: ARG001
    bar: Vector,  # noqa: ARG001
    columns: Matrix,
    component: int,  # noqa: ARG001
) -> Matrix:
    """Return NaN: an input that is planned with it ends the trial as diverged."""
    return np.full((1 + columns.shape[0], 1 + columns.shape[0]), np.nan)
