"""Base classes of learner specifications, and of updates that a user writes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dopt.errors import SpecificationError
from dopt.fields import IN_NUMPY, KernelPart, parameter
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array as Array


@dataclass(frozen=True, kw_only=True)
class Learner(KernelPart):
    """An online update of the model's parameters from the samples seen so far.

    ``structure`` is the kind of model this learner can train (:class:`dopt.models.Model`), and
    ``updates_information`` says whether its step also adds the sample to the information matrix.
    ``reads_inputs`` says whether it teaches models that depend on the inputs, and
    ``estimates_states`` whether it learns from measured states with noise by estimating all states.
    """

    section: ClassVar[str] = "learner"
    name: ClassVar[str]
    structure: ClassVar[str] = "gradient"
    updates_information: ClassVar[bool] = False
    reads_inputs: ClassVar[bool] = False
    estimates_states: ClassVar[bool] = False

    def samples_kept(self, horizon: int) -> int:  # noqa: ARG002  # of most learners, none
        """Return how many of the newest samples the kernel keeps in a trial of so many steps."""
        return 0

    def largest_batch(self) -> int:
        """Return the most samples that the kernel takes a gradient of at once."""
        return 1

    def memory_size(self, system: System, n_parameters: int) -> int:  # noqa: ARG002  # of learners that keep nothing
        """Return how many numbers the learner keeps from step to step; they start at zero."""
        return 0


class Updater(ABC):
    """The learning of one trial; it may keep moments, samples or covariances."""

    @abstractmethod
    def update(self, view: TrialView) -> Array:
        """Return the new parameters, (q,), after a step; the newest sample is the last one."""


@dataclass(frozen=True, kw_only=True)
class CustomLearner(Learner):
    """A learner whose update is written in numpy.

    In the kernel the interpreter calls it between compiled steps.
    """

    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = IN_NUMPY

    @abstractmethod
    def updater(self, system: System, rng: np.random.Generator) -> Updater:
        """Return the learning of a new trial; all that is random in it comes from ``rng``."""


@dataclass(frozen=True, kw_only=True)
class CompiledLearner(Learner):
    """A learner whose update the kernel compiles.

    Derived from CustomLearner as well, it runs on both paths.

    The update is a plain function of numbers and arrays as Numba compiles them; its helpers lie in
    the same module, or are functions of :mod:`dopt.kernel`. Its file is part of a trial's key.
    """

    compiled: ClassVar[bool] = True
    brings_function: ClassVar[bool] = True

    @staticmethod
    @abstractmethod
    def learn(
        trial: Any,  # a Trial of the kernel, which this package does not import
        t: int,
        target: Array,
    ) -> None:
        """Update ``trial.state.theta``, (q,), after step t, in place.

        Parameters
        ----------
        trial : dopt.kernel.structs.Trial
            ``record.states[: t + 2]`` are x_0 ... x_{t+1}; ``algorithm.learner`` holds the numeric
            fields of the learner in their order, and ``state.learner_memory`` what it keeps.
        t : int
            Number of the step that was just done, from 0.
        target : (r,)
            Accelerations observed in step t.
        """


def check_update(name: str, updated: Array, shape: tuple[int, ...]) -> None:
    """Raise SpecificationError if a learner has returned parameters of another shape."""
    if updated.shape != shape:
        none = updated.shape == () and np.isnan(updated)
        given = "None" if none else f"parameters of shape {updated.shape}"
        raise SpecificationError(
            f"learner '{name}' returned {given}, but parameters of shape {shape} are expected: "
            f"correct its update()."
        )


@dataclass(frozen=True, kw_only=True)
class InformationLearner(Learner):
    """A learner that updates θ and the information matrix M together.

    There is one information matrix. With a policy that plans by M the learner uses the policy's
    matrix, with its λ; with any other it holds one of its own. M is held as a q × q matrix.

    Parameters
    ----------
    regularization : float
        λ of a learner with a matrix of its own; with ρ = 1 it is the ratio of the variance of the
        observations to the variance of the initial parameters.
    noise_variance : float
        ρ, in the units in which the parameters have the variance 1/λ.
    """

    updates_information: ClassVar[bool] = True

    regularization: float = parameter(1e-3, bound="positive")
    noise_variance: float = parameter(1.0, bound="positive")
