"""Base classes of policy specifications, and of plans that a user writes.

A policy is either open-loop, and gives its whole input sequence before the trial, or closed-loop,
and names the plan that chooses each input from what was observed. A closed-loop policy that the
kernel does not know brings its plan along, a :class:`Planner`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dopt.control.task import Control, Feedback, Goal
from dopt.errors import IncompatibleError, SpecificationError
from dopt.fields import IN_NUMPY, KernelPart, parameter
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array as Array

ROUNDING = 1e-9
"""Share of γ by which an input may exceed it."""


def check_length(key: str, steps: int, system: System) -> None:
    """Raise IncompatibleError if a plan is longer than a trial of the system."""
    if steps > system.horizon:
        raise IncompatibleError(
            f"{key} is {steps} steps, but a trial of env '{system.name}' has {system.horizon}: "
            f"lower it, or raise env.horizon."
        )


def check_ensemble(networks: int) -> None:
    """Raise SpecificationError if a policy has fewer than two networks that could disagree."""
    if networks < 2:
        raise SpecificationError(
            f"policy.ensemble is {networks}, but at least 2 networks are expected, as one network "
            f"cannot disagree with itself: set policy.ensemble to 2 or more."
        )


@dataclass(frozen=True, kw_only=True)
class Policy(KernelPart):
    """A rule that chooses the input u_t, ‖u_t‖ ≤ γ.

    ``reads_inputs`` says whether it goes with models that depend on the inputs.
    """

    section: ClassVar[str] = "policy"
    name: ClassVar[str]
    reads_inputs: ClassVar[bool] = False

    def check(self, system: System) -> None:
        """Raise IncompatibleError if the policy makes no sense for a system."""

    def memory_size(self, system: System, n_parameters: int) -> int:  # noqa: ARG002  # of policies that keep nothing
        """Return how many numbers the policy keeps from step to step; they start at zero."""
        return 0


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Policy):
    """A policy whose inputs do not depend on what is observed.

    ``exceeds`` says that single inputs may be larger than γ.
    """

    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.plan_drawn"
    reads_inputs: ClassVar[bool] = True
    exceeds: ClassVar[bool] = False

    @abstractmethod
    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        """Return the input sequence, (T, m)."""


@dataclass(frozen=True, kw_only=True)
class InformationPolicy(Policy):
    """A closed-loop policy that plans with the information matrix M of the parameters.

    M₀ = λI. Accumulated information is M_{t+1} = M_t + JᵀJ with J at x_t and the parameters after
    the learning step of time t: each row belongs to the parameters of its own time. Fresh
    information is M_{t+1} = λI + Σ JᵀJ over x_0 ... x_t with all rows at the parameters after the
    learning step of time t, where t + 1 is a multiple of ``refresh_every``; at other times the
    newest rows are added. For a model that is linear in its parameters both are the same, and a
    learner that updates M decides about it: fresh information goes with neither
    (:mod:`dopt.spec.compatibility`). The first input is uniform on the sphere.

    Parameters
    ----------
    regularization : float
        λ.
    information : {"accumulated", "fresh"}
        At which parameters the rows of M are taken. Fresh information is held as a q × q matrix.
    refresh_every : int
        Steps from one sum of fresh rows to the next; 1 where information is accumulated.
    """

    regularization: float = parameter(1e-3, bound="positive")
    information: str = parameter("accumulated", choices=("accumulated", "fresh"), added=True)
    refresh_every: int = parameter(1, "steps", "positive", added=True)

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # of most, one
        """Return how M is held for q parameters and N rows in the whole trial.

        It is "primal", "dual" or "sketch" (:class:`dopt.policies.d_optimal.DOptimal`).
        """
        return "primal"


class Planner(ABC):
    """The plan of one trial; it may keep what it learns itself."""

    @abstractmethod
    def choose(self, view: TrialView) -> Array:
        """Return the input u_t, (m,), ‖u_t‖ ≤ γ, after t ≥ 1 steps: the first one is random.

        An input that is not finite is refused, or ends the trial as diverged where the parameters
        of the model have grown so large that a plan may overflow.
        """

    def observe(self, view: TrialView) -> None:  # noqa: B027  # most plans keep nothing
        """Take in a step that was just done and learned from, t ≥ 1: x_{t-1}, u_{t-1} and x_t."""

    def feedback(self) -> Feedback | None:
        """Return the law by which the plan would solve the trial's task, as learned so far.

        It does not change afterwards. None where the plan learns no task.
        """
        return None


@dataclass(frozen=True, kw_only=True)
class CustomPolicy(Policy):
    """A closed-loop policy whose plan is written in numpy.

    In the kernel the interpreter calls it between compiled steps.
    """

    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = IN_NUMPY

    @abstractmethod
    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        """Return the plan of a new trial; all that is random in it comes from ``rng``."""


@dataclass(frozen=True, kw_only=True)
class TaskPolicy(CustomPolicy):
    """A policy that learns the control task of the trial, or by default of the system.

    Its plan has a law of feedback (:meth:`Planner.feedback`), which is assessed beside the model.
    """

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        return self.task_planner(system, Control().on(system), rng)

    @abstractmethod
    def task_planner(self, system: System, goal: Goal, rng: np.random.Generator) -> Planner:
        """Return the plan of a new trial with a goal; all that is random comes from ``rng``."""


@dataclass(frozen=True, kw_only=True)
class CompiledPolicy(Policy):
    """A closed-loop policy whose plan the kernel compiles.

    Derived from CustomPolicy as well, it runs on both paths. They agree where all that is random in
    the plan comes from the direction of the step, ``randomness.ties[t]`` here and
    :attr:`dopt.trial_view.TrialView.tie` there.

    The plan is a plain function of numbers and arrays as Numba compiles them; its helpers lie in
    the same module, or are functions of :mod:`dopt.kernel`. Its file is part of a trial's key.
    """

    compiled: ClassVar[bool] = True
    brings_function: ClassVar[bool] = True

    @staticmethod
    @abstractmethod
    def plan(
        trial: Any,  # a Trial of the kernel, which this package does not import
        t: int,
        u: Array,
    ) -> None:
        """Write the input u_t, (m,), ‖u_t‖ ≤ γ, of a step t ≥ 1: the first one is random.

        Parameters
        ----------
        trial : dopt.kernel.structs.Trial
            ``record.states[: t + 1]`` are x_0 ... x_t; ``algorithm.policy`` holds the numeric
            fields of the policy in their order, ``randomness.ties[t]`` a random direction, (m,),
            and ``state.policy_memory`` what the policy keeps.
        t : int
            Number of the step.
        u : (m,)
            Where the input is written. One that is not finite ends the trial as diverged.
        """


def check_choice(name: str, chosen: Array, t: int, system: System) -> None:
    """Raise SpecificationError if the input of step t has the wrong shape or is larger than γ."""
    if chosen.shape != (system.n_inputs,):
        raise SpecificationError(
            f"policy '{name}' chose an input of shape {chosen.shape} at step {t}, but "
            f"{(system.n_inputs,)} is expected: correct its choose()."
        )
    check_norms(name, chosen[None], t, system.gamma)


def check_norms(name: str, inputs: Array, first: int, gamma: float) -> None:
    """Raise SpecificationError if an input, a row of (n, m), is larger than γ.

    ``first`` is the step of the first row.
    """
    norms = np.linalg.norm(inputs, axis=1)
    wrong = np.flatnonzero(norms > gamma * (1 + ROUNDING))
    if len(wrong):
        raise SpecificationError(
            f"policy '{name}' chose an input of norm {norms[wrong[0]]:.6g} at step "
            f"{first + wrong[0]}, but env.gamma is {gamma:g}: scale it down."
        )


def ball_norms(rng: np.random.Generator, size: tuple[int, int], dimensions: int | Array) -> Array:
    """Return norms of points that are drawn uniformly from the unit ball of some dimensions."""
    return rng.uniform(size=size) ** (1.0 / dimensions)


def on_sphere(vectors: Array, radius: float) -> Array:
    """Return vectors, (..., m), scaled to a norm."""
    scaled: Array = radius * vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled
