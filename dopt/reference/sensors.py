"""States that are measured with noise, and estimates of them by a filter, for a batch of trials.

The rules are those of :mod:`dopt.kernel.sensors`.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from dopt.reference.state import BatchState
from dopt.systems.black_box import delay, differentiated


class BatchSensors:
    """Outputs of a batch of n trials, and the states that are estimated from them.

    Attributes
    ----------
    C : (k, d) tensor
        Matrix of the k outputs y = C x + v.
    outputs : (n, T, k) tensor
        What was measured after each step.
    durations : list of float
        Seconds of each step.
    starts : (n, T, d) tensor
        States from which steps begin anew; NaN where they follow one another.
    start_variances : (d,) tensor
        Variances of these states; the initial state of a simulation is known.
    """

    def __init__(self, batch: BatchState) -> None:
        system = batch.system
        self._batch, self._rows = batch, list(system.measured_states)
        self.C = batch.tensor(system.output_rows)
        self.variances = batch.tensor(np.array(system.measurement_noise)) ** 2
        self.outputs = batch.theta.new_full(
            (len(batch.specs), system.horizon, system.n_measured), float("nan")
        )
        self.durations: list[float] = []
        self.starts = torch.full_like(batch.states[:, 1:], torch.nan)
        self.starts[:, 0] = batch.states[:, 0]
        self.start_variances = torch.zeros_like(batch.states[0, 0])
        self._filters = not batch.config.learner.estimates_states
        if self._filters:
            self._positions, self._delay = differentiated(system), delay(system)
        self._filtered = torch.zeros_like(self.outputs[:, 0])
        self._rates, self._last = self._filtered.clone(), self._filtered.clone()
        self._input, self._inputs = batch.inputs[:, 0].clone(), torch.zeros_like(batch.inputs)

    def measure(self, t: int) -> None:
        """Measure the outputs at x_{t+1}, with their noise."""
        batch = self._batch
        self.outputs[:, t] = batch.true_states[:, t + 1] @ self.C.mT + batch.measurement_noise[:, t]

    def output_errors(self, t: int, dt: float) -> Tensor:
        """Return the errors of the predictions of what was measured of x_{t+1}, (n,).

        They are Euclidean norms, each output in standard deviations of its noise.
        """
        batch = self._batch
        x, u = batch.states[:, t], batch.inputs[:, t]
        predicted = batch.learned.next_states(batch.theta, x, u, dt)
        errors = self.outputs[:, t] - predicted @ self.C.mT
        norms: Tensor = torch.linalg.vector_norm(errors / self.variances.sqrt(), dim=1)
        return norms

    def estimate(self, t: int, dt: float) -> None:
        """Write an estimate of x_{t+1}, of which the outputs were measured dt seconds later."""
        batch = self._batch
        x, following, u = batch.states[:, t], batch.states[:, t + 1], batch.inputs[:, t]
        self.durations[t:] = [dt]
        if not self._filters:
            following.copy_(batch.learned.next_states(batch.theta, x, u, dt))
            return
        self._begin_filters(t)
        share = -math.expm1(-2.0 * math.pi * batch.system.velocity_cutoff * dt)
        y = self.outputs[:, t]
        self._rates = self._rates + share * ((y - self._last) / dt - self._rates)
        change, self._last = share * (y - self._filtered), y
        self._filtered = self._filtered + change
        following[:, self._rows] = self._filtered - self._delay * change
        for state, position in enumerate(self._positions):
            if position != state:
                following[:, state] = self._rates[:, self._rows.index(position)]
        change = share * (u - self._input)
        self._input = self._input + change
        self._inputs[:, t] = self._input - self._delay * change

    def _begin_filters(self, t: int) -> None:
        """Let the filters begin at the states from which step t begins anew, if it does."""
        start = self.starts[:, t]
        anew = start[:, :1].isfinite()
        self._filtered = torch.where(anew, start[:, self._rows], self._filtered)
        self._last = torch.where(anew, start[:, self._rows], self._last)
        self._input = torch.where(anew, 0.0, self._input)
        for state, position in enumerate(self._positions):
            if position != state:
                place = self._rows.index(position)
                known = torch.where(anew[:, 0], start[:, state], self._rates[:, place])
                self._rates[:, place] = known

    def sampled_inputs(self, steps: int | slice) -> Tensor:
        """Return the inputs that belong to the accelerations observed in some steps."""
        if not self._filters:
            return self._batch.inputs[:, steps]
        filtered: Tensor = self._inputs[:, steps]
        return filtered
