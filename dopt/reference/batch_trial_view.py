"""View of one trial of a batch, for a plan or an update of a user's own."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import jacrev, jvp, vmap

from dopt.reference.dynamics import input_matrix, next_states
from dopt.reference.state import BatchState
from dopt.trial_view import Array, TrialView


class BatchTrialView(TrialView):
    """Trial ``index`` of a batch after t steps.

    Attributes
    ----------
    model : callable
        a_θ(x) over tensors: parameters (q,) and state (d,) to accelerations (r,).
    theta : (q,) tensor
        Parameters, for plans that are written in torch.
    """

    def __init__(self, batch: BatchState, index: int, t: int) -> None:
        self.system, self.t = batch.system, t
        self.model, self.theta = batch.model, batch.theta[index].clone()
        self.states = _array(batch.states[index, : t + 1])
        self.inputs = _array(batch.inputs[index, :t])
        self.sampled_inputs = _array(batch.sampled_inputs(slice(0, t))[index])
        self.sampled = _array(batch.sampled_states[index, :t])
        self.accelerations = _array(batch.targets[index, :t])
        self.parameters = _array(self.theta)

    def predict(self, states: Array) -> Array:
        return _array(vmap(self.model, in_dims=(None, 0))(self.theta, self.tensor(states)))

    def jacobian(self, state: Array) -> Array:
        return _array(jacrev(self.model)(self.theta, self.tensor(state)))

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        def rows(x: Tensor) -> Tensor:
            J: Tensor = jacrev(self.model)(self.theta, x)
            return J

        x = self.tensor(state)
        return _array(vmap(lambda along: jvp(rows, (x,), (along,))[1])(self.tensor(directions)))

    def following(self, state: Array, inputs: Array) -> Array:
        x, u = self.tensor(state), self.tensor(inputs)
        x = x.expand(len(u), -1)
        modelled = vmap(self.model, in_dims=(None, 0))
        system = self.system
        return _array(next_states(system, x, u, lambda z: modelled(self.theta, z), system.dt))

    def input_matrix(self, state: Array) -> Array:
        return _array(input_matrix(self.system, self.tensor(state)))

    def tensor(self, values: Array) -> Tensor:
        """Return values as a tensor where the model is."""
        return torch.as_tensor(values, dtype=self.theta.dtype, device=self.theta.device)


def _array(values: Tensor) -> Array:
    """Return a copy, so that nobody can change the trial."""
    array: Array = values.detach().cpu().numpy().copy()
    return array
