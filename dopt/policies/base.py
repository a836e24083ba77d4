"""What every policy specification declares.

A policy is either open-loop, and gives its whole input sequence before the trial, or closed-loop,
and names the plan that chooses each input from what was observed. A closed-loop policy that the
kernel does not know brings its plan along, a :class:`Planner`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.errors import IncompatibleError
from dopt.fields import Checked, quantity
from dopt.systems.base import System
from dopt.view import View

Array = npt.NDArray[np.float64]

ROUNDING = 1e-9
"""Share of γ by which an input may exceed it."""


def check_length(key: str, steps: int, system: System) -> None:
    """Raise IncompatibleError if a plan is longer than a trial of the system."""
    if steps > system.horizon:
        raise IncompatibleError(
            f"{key} is {steps} steps, but a trial of env '{system.name}' has {system.horizon}: "
            f"lower it, or raise env.horizon."
        )


@dataclass(frozen=True, kw_only=True)
class Policy(Checked):
    """A rule that chooses the input u_t, ‖u_t‖ ≤ γ.

    ``compiled`` says whether the kernel runs it; what it does not runs on the reference path.
    """

    section: ClassVar[str] = "policy"
    name: ClassVar[str]
    compiled: ClassVar[bool] = True

    def check(self, system: System) -> None:
        """Raise IncompatibleError if the policy makes no sense for a system."""


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Policy):
    """A policy whose inputs do not depend on what is observed.

    ``exceeds`` says that single inputs may be larger than γ.
    """

    exceeds: ClassVar[bool] = False

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


class Planner(ABC):
    """The plan of one trial; it may keep what it learns itself."""

    @abstractmethod
    def choose(self, view: View) -> Array:
        """Return the input u_t, (m,), ‖u_t‖ ≤ γ, after t ≥ 1 steps: the first one is random.

        An input that is not finite ends the trial as diverged.
        """

    def observe(self, view: View) -> None:  # noqa: B027  # most plans keep nothing
        """Take in a step that was just done and learned from, t ≥ 1: x_{t-1}, u_{t-1} and x_t."""


@dataclass(frozen=True, kw_only=True)
class Planned(ClosedLoop):
    """A closed-loop policy whose plan is written in numpy; it runs on the reference path."""

    compiled: ClassVar[bool] = False

    @abstractmethod
    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        """Return the plan of a new trial; all that is random in it comes from ``rng``."""


def on_sphere(vectors: Array, radius: float) -> Array:
    """Return vectors, (..., m), scaled to a norm."""
    scaled: Array = radius * vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled
