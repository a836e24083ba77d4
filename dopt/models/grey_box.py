"""The system's own equations, with some of their physical parameters unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.models.base import Array, Model
from dopt.systems.base import Feature, System
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class GreyBox(Model):
    """a_θ(x) is the system's a(x) with θ in the place of its unknown physical parameters.

    The equations may depend on θ in any way; where they are affine in it, :class:`Linear` is the
    same model, solved for. A system that changes with time is modelled as one that does not, with
    its known parameters as at the start: a learner that forgets can follow the unknown ones.

    Parameters
    ----------
    unknown : tuple of str
        Names of unknown parameters, out of the system's ``physical``; empty: its
        ``linear_parameters``.
    initial : tuple of float
        First guess of each, in its unit; empty: 1 of each.
    spread : float
        Standard deviation of a trial's initial parameters about the first guess, in their units.
    """

    name: ClassVar[str] = "grey_box"
    compiled: ClassVar[bool] = True

    unknown: tuple[str, ...] = parameter(())
    initial: tuple[float, ...] = parameter(())
    spread: float = parameter(0.1, bound="nonnegative")

    def names(self, system: System) -> tuple[str, ...]:
        """Return the names of the q parameters that are learned."""
        return self.unknown or system.linear_parameters

    def n_parameters(self, system: System) -> int:
        return len(self.names(system))

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        guess = np.array(self.initial or [1.0] * self.n_parameters(system))
        return guess + self.spread * rng.standard_normal(len(guess))

    def n_inputs_read(self, system: System) -> int:
        return system.n_inputs if system.reads_inputs else 0

    def features(self, system: System) -> tuple[Feature, ...]:
        """Return the point itself: the equations read states, and the inputs where they count."""
        read = system.n_states + self.n_inputs_read(system)
        return tuple(Feature("identity", index) for index in range(read))

    def feature_scales(self, system: System) -> tuple[float, ...]:
        return (1.0,) * len(self.features(system))

    def physical_values(self, system: System, theta: Sequence[Scalar]) -> list[Scalar]:
        """Return all physical parameters in their order, with q unknown ones, each of any kind."""
        values = dict(zip(system.physical, system.parameters, strict=True))
        return list((values | dict(zip(self.names(system), theta, strict=True))).values())

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        values = self.physical_values(system, parameters.tolist())
        rows = system.accelerations(tuple(points.T), values)
        return np.stack(np.broadcast_arrays(*rows, points[:, 0])[:-1], axis=-1)
