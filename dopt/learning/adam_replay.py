"""Adam on minibatches of all samples so far: experience replay.

Reference: L.-J. Lin, "Self-improving reactive agents based on reinforcement learning, planning and
teaching", Machine Learning 8 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.declare.validated_fields import parameter
from dopt.learning.adam import AdamRule


@dataclass(frozen=True, kw_only=True)
class AdamReplay(AdamRule):
    """Some Adam steps at each time step, each on samples drawn from the buffer with replacement.

    The sample of time t takes place t mod ``capacity`` of the buffer, in which the oldest one was.

    Parameters
    ----------
    capacity : int
        Number of newest samples that the buffer holds.
    batch : int
        Samples of a minibatch.
    steps : int
        Minibatches, and Adam steps, at each time step.
    """

    name: ClassVar[str] = "adam_replay"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.replay.learn"
    reads_inputs: ClassVar[bool] = True

    learning_rate: float = parameter(3e-3, bound="positive")
    capacity: int = parameter(10_000, "samples", "positive")
    batch: int = parameter(100, "samples", "positive")
    steps: int = parameter(30, "steps", "positive")

    def samples_kept(self, horizon: int) -> int:
        return min(self.capacity, horizon)

    def largest_batch(self) -> int:
        return self.batch

    def places(self, horizon: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Draw the places of the buffer that the minibatches are made of, (T, steps, batch).

        At time t they are uniform over the min(t + 1, capacity) places that hold a sample.
        """
        filled = np.minimum(np.arange(1, horizon + 1), self.capacity)
        return rng.integers(filled[:, None, None], size=(horizon, self.steps, self.batch))
