"""Adam on the newest sample (Algorithm 1 as printed), on a window of recent samples, or on replay.

One step per time step t on the mean over the samples of ‖a_θ(x) - y‖², with y the observed
accelerations (x_{t+1} - x_t)/dt less their known part.

References: D. Kingma and J. Ba, "Adam: a method for stochastic optimization" (2015); L.-J. Lin,
"Self-improving reactive agents based on reinforcement learning, planning and teaching", Machine
Learning 8 (1992), for minibatches of all samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import parameter
from dopt.learning.base import Learner


@dataclass(frozen=True, kw_only=True)
class AdamRule(Learner):
    """Base of the learners that take Adam's steps.

    Parameters
    ----------
    learning_rate : float
        Step size η.
    beta_1, beta_2 : float
        Decay rates of the first and the second moment.
    epsilon : float
        Regulariser of the denominator.
    """

    learning_rate: float = parameter(2e-3, bound="positive")
    beta_1: float = parameter(0.9, bound="fraction")
    beta_2: float = parameter(0.999, bound="fraction")
    epsilon: float = parameter(1e-8, bound="positive")


@dataclass(frozen=True, kw_only=True)
class Adam(AdamRule):
    """One Adam step on the newest sample at each time step.

    Parameters
    ----------
    window : int
        Number of newest samples in the loss; while fewer have been seen, those.
    """

    name: ClassVar[str] = "adam"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.adam.learn"
    reads_inputs: ClassVar[bool] = True

    window: int = parameter(1, "samples", "positive")

    def samples_kept(self, horizon: int) -> int:  # noqa: ARG002  # the window has its own size
        return self.window

    def largest_batch(self) -> int:
        return self.window


@dataclass(frozen=True, kw_only=True)
class AdamWindow(Adam):
    """One Adam step on the newest 100 samples, as in the authors' released code."""

    name: ClassVar[str] = "adam_window"
    compiled: ClassVar[bool] = True

    learning_rate: float = parameter(1e-2, bound="positive")
    window: int = parameter(100, "samples", "positive")


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
    kernel_function: ClassVar[str] = "dopt.kernel.learners.adam.learn_from_replay"
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
