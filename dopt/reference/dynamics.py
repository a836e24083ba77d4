"""True and predicted dynamics over tensors: the equations of :mod:`dopt.systems` themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from dopt.reference.models import stack
from dopt.systems.base import System


def known_flow(system: System, x: Tensor, u: Tensor) -> Tensor:
    """Return the known part of dx/dt, (..., d), for states (..., d) and inputs (..., m)."""
    return stack(system.known(x.unbind(-1), u.unbind(-1), system.parameters))


def true_accelerations(system: System, x: Tensor, step: int) -> Tensor:
    """Return a(x) at a step, (..., r), for states (..., d)."""
    parameters = system.history[min(step, len(system.history) - 1)].tolist()
    return stack(system.accelerations(x.unbind(-1), parameters))


def flow(system: System, x: Tensor, u: Tensor, accelerations: Tensor) -> Tensor:
    """Return known(x, u) + E a, (..., d)."""
    rows = torch.tensor(system.learned_rows, device=x.device)
    return known_flow(system, x, u).index_add(-1, rows, accelerations)


def input_matrix(system: System, x: Tensor) -> Tensor:
    """Return B = dt ∂f/∂u, (d, m), at one state (d,)."""

    def by_input(u: Tensor) -> Tensor:
        return known_flow(system, x, u)

    zero = torch.zeros(system.n_inputs, dtype=x.dtype, device=x.device)
    columns: Tensor = torch.func.jacfwd(by_input)(zero)
    return system.dt * columns
