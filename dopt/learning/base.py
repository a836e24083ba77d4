"""What every learner specification declares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import Checked


@dataclass(frozen=True, kw_only=True)
class Learner(Checked):
    """An online update of the model's parameters from the samples seen so far."""

    section: ClassVar[str] = "learner"
    name: ClassVar[str]
