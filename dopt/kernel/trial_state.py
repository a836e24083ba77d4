"""State of a trial in the compiled kernel, however its steps are taken."""

from __future__ import annotations

import numpy as np

from dopt.kernel.from_spec import trial_of
from dopt.randomness import draw
from dopt.spec.trial import TrialSpec
from dopt.types import Array


class KernelState:
    """Observations and learned parameters of a trial in the compiled kernel.

    Attributes
    ----------
    trial : Trial
        Arguments of the compiled functions.
    state, record : State, Record
        Its arrays that they write in place.
    """

    def __init__(self, spec: TrialSpec) -> None:
        draws = draw(spec)
        self.spec, self.trial = spec, trial_of(spec, draws)
        self.state, self.record = self.trial.state, self.trial.record
        n_fixed = spec.model.n_fixed_parameters(spec.system)
        self._fixed = draws.weights[len(draws.weights) - n_fixed :]

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,), of all members, and those that stay as they were drawn."""
        if self.state.members.parameters.shape[0] > 0:
            return self.state.members.parameters.flatten()
        return np.concatenate([self.state.theta, self._fixed])

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet.

        Of a simulation they are the true ones.
        """
        return self.record.true_states
