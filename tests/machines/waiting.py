"""Policy whose trials take time but no processor, as the trials of a plant in real time do."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import parameter
from dopt.policies.base import OpenLoop
from dopt.systems.base import System

SECONDS = 0.25


@dataclass(frozen=True, kw_only=True)
class Waiting(OpenLoop):
    """No inputs, after so many seconds."""

    name: ClassVar[str] = "waiting"

    seconds: float = parameter(SECONDS, "s", "positive")

    def inputs(
        self,
        system: System,
        rng: np.random.Generator,  # noqa: ARG002  # nothing is random here
    ) -> npt.NDArray[np.float64]:
        time.sleep(self.seconds)
        return np.zeros((system.horizon, system.n_inputs))
