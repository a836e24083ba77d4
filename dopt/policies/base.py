"""What every policy specification declares.

A policy is either open-loop, and gives its whole input sequence before the trial, or closed-loop,
and names the plan that chooses each input from what was observed.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import Checked, quantity
from dopt.systems.base import System

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Policy(Checked):
    """A rule that chooses the input u_t, ‖u_t‖ ≤ γ."""

    section: ClassVar[str] = "policy"
    name: ClassVar[str]

    def check(self, system: System) -> None:
        """Raise IncompatibleError if the policy makes no sense for a system."""


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Policy):
    """A policy whose inputs do not depend on what is observed."""

    @abstractmethod
    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        """Return the input sequence, (T, m)."""


@dataclass(frozen=True, kw_only=True)
class ClosedLoop(Policy):
    """A policy that plans each input from the past and the current model."""


@dataclass(frozen=True, kw_only=True)
class Informed(ClosedLoop):
    """A closed-loop policy that plans with the information matrix M of the parameters.

    M₀ = λI, and M_{t+1} = M_t + JᵀJ with J at (x_t, u_t) and the parameters after the learning step
    of time t. The first input is uniform on the sphere.

    Parameters
    ----------
    regularization : float
        λ.
    """

    regularization: float = quantity(1e-3, bound="positive")

    @abstractmethod
    def chosen_form(self, n_parameters: int, n_rows: int) -> str:
        """Return how M is held for q parameters and N rows in the whole trial.

        It is "primal", "dual" or "sketch" (:class:`dopt.policies.d_optimal.DOptimal`).
        """


def on_sphere(vectors: Array, radius: float) -> Array:
    """Return vectors, (..., m), scaled to a norm."""
    scaled: Array = radius * vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled
