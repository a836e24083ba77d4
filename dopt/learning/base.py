"""What every learner specification declares."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import Checked
from dopt.systems.base import System
from dopt.view import View

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Learner(Checked):
    """An online update of the model's parameters from the samples seen so far.

    ``compiled`` says whether the kernel runs it; what it does not runs on the reference path.
    ``structure`` is that of the models which it teaches (:class:`dopt.models.Model`).
    """

    section: ClassVar[str] = "learner"
    name: ClassVar[str]
    structure: ClassVar[str] = "gradient"
    compiled: ClassVar[bool] = True


class Updater(ABC):
    """The learning of one trial; it may keep moments, samples or covariances."""

    @abstractmethod
    def update(self, view: View) -> Array:
        """Return the new parameters, (q,), after a step; the newest sample is the last one."""


@dataclass(frozen=True, kw_only=True)
class Updated(Learner):
    """A learner whose update is written in numpy; it runs on the reference path."""

    compiled: ClassVar[bool] = False

    @abstractmethod
    def updater(self, system: System, rng: np.random.Generator) -> Updater:
        """Return the learning of a new trial; all that is random in it comes from ``rng``."""
