"""View of one trial of a batch, for a plan or an update of a user's own."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dopt.reference.derivatives import gradients_and_changes
from dopt.reference.dynamics import input_matrix
from dopt.reference.state import BatchState
from dopt.trial_view import Array, TrialView


class BatchTrialView(TrialView):
    """Trial ``index`` of a batch after t steps.

    Attributes
    ----------
    theta : (q,) tensor
        All parameters, for plans that are written in torch.
    """

    def __init__(self, batch: BatchState, index: int, t: int) -> None:
        self.system, self.t = batch.system, t
        self._learned, self.theta = batch.learned, batch.theta[index].clone()
        self._size = batch.n_learned
        self.states = _array(batch.states[index, : t + 1])
        self.inputs = _array(batch.inputs[index, :t])
        self.sampled_inputs = _array(batch.sampled_inputs(slice(0, t))[index])
        self.sampled = _array(batch.sampled_states[index, :t])
        self.accelerations = _array(batch.targets[index, :t])
        self.parameters = _array(self.theta[: self._size])
        last = t == self.system.horizon
        self.tie = np.full(self.system.n_inputs, np.nan) if last else _array(batch.ties[index, t])

    def model(self, theta: Tensor, state: Tensor) -> Tensor:
        """Return a_θ(x), (r,), for parameters (q,) and a state (d,), differentiable by torch."""
        return self._learned.model(theta[None], state[None, None])[0, 0]

    def points(self, states: Array, inputs: Array) -> Array:
        return _array(self._learned.points(self.tensor(states), self.tensor(inputs)))

    def predict(self, states: Array) -> Array:
        return _array(self._learned.model(self.theta[None], self.tensor(states)[None])[0])

    def jacobian(self, state: Array) -> Array:
        J = self._learned.jacobian(self.theta[None], self.tensor(state)[None, None])[0, 0]
        return _array(J[:, : self._size])

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        along, r = self.tensor(directions), self.system.n_learned
        items = len(along) * r
        _, changes = gradients_and_changes(
            self._learned.model,
            self.theta.expand(items, -1),
            self.tensor(state).expand(items, -1),
            torch.arange(r, device=along.device).repeat(len(along)),
            along.repeat_interleave(r, dim=0),
        )
        return _array(changes.view(len(along), r, -1)[..., : self._size])

    def following(self, state: Array, inputs: Array) -> Array:
        u = self.tensor(inputs)
        x, theta = (one.expand(len(u), -1) for one in (self.tensor(state), self.theta))
        return _array(self._learned.next_states(theta, x, u, self.system.dt))

    def input_matrix(self, state: Array) -> Array:
        return _array(input_matrix(self.system, self.tensor(state)[None])[0])

    def tensor(self, values: Array) -> Tensor:
        """Return values as a tensor where the model is."""
        contiguous = np.ascontiguousarray(values)  # torch takes no negative strides
        return torch.as_tensor(contiguous, dtype=self.theta.dtype, device=self.theta.device)


def _array(values: Tensor) -> Array:
    """Return a copy, so that nobody can change the trial."""
    array: Array = values.detach().cpu().numpy().copy()
    return array
