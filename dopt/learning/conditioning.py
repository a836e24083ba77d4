"""Conditioning of a Gaussian process on all samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.learning.base import Learner


@dataclass(frozen=True, kw_only=True)
class Conditioning(Learner):
    """The exact posterior given every sample seen, by a factor that grows by a row a step.

    It costs t² at step t in time and memory, the drawback that the paper names.
    """

    name: ClassVar[str] = "conditioning"
    structure: ClassVar[str] = "conditioning"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.conditioning.learn"
