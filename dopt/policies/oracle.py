"""Oracle: D-optimal exploration with the physical parametrisation of the true system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.d_optimal import DOptimal
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Oracle(DOptimal):
    """D-optimal inputs for the physical parametrisation, learned by least squares (section 3).

    It goes with ``model=linear`` and ``learner=recursive_least_squares``.

    Parameters
    ----------
    regularization : float
        λ, the ridge of the least squares as well.
    """

    name: ClassVar[str] = "oracle"
    compiled: ClassVar[bool] = True

    regularization: float = parameter(1e-6, bound="positive")

    def check(self, system: System) -> None:
        if not system.linear_parameters:
            raise IncompatibleError(
                f"policy 'oracle' needs dynamics that are linear in unknown parameters, but env "
                f"'{system.name}' declares none: choose another policy."
            )
