"""Models of the reference for one trial and one point, as ``torch.func`` differentiates them."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from dopt.models import Model
from dopt.reference.models import BatchModel, model_function
from dopt.systems.base import System


def for_one(model: BatchModel) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a_θ: parameters (q,) and a point, (d,) or (d + m,), to accelerations (r,)."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        return model(theta[None], x[None, None])[0, 0]

    return accelerations


def model_of_one(system: System, model: Model) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a_θ of a registered model, for one trial and one point."""
    return for_one(model_function(system, model))
