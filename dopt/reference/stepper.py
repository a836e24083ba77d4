"""A trial of the reference that can be advanced in pieces and looked at in between."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from dopt.errors import SpecificationError
from dopt.reference.batch import Lockstep
from dopt.spec.trial import TrialSpec

Array = npt.NDArray[np.float64]


class ReferenceTrial:
    """A batch of one trial.

    Attributes
    ----------
    done : int
        Number of steps done.
    diverged_at : int or None
        Step at which the trial diverged.
    """

    def __init__(self, spec: TrialSpec) -> None:
        with torch.no_grad():
            self._batch = Lockstep([spec])
        self.done = 0
        self.diverged_at: int | None = None

    @torch.no_grad()
    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged.

        Raises
        ------
        SpecificationError
            If ``last`` lies beyond the horizon.
        """
        horizon = self._batch.system.horizon
        if last > horizon:
            raise SpecificationError(
                f"step {last} was asked for, but the horizon is {horizon}: raise env.horizon."
            )
        while self.done < last and self.diverged_at is None:
            self._batch.step(self.done)
            if bool(self._batch.diverged[0]):
                self.diverged_at = self.done
            else:
                self.done += 1

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,)."""
        parameters: Array = self._batch.parameters_of_model[0].numpy()
        return parameters

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet."""
        states: Array = self._batch.states[0].numpy()
        return states
