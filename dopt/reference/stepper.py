"""A trial of the reference: advanced in pieces, or by steps between which a plant is measured."""

from __future__ import annotations

import functools
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch

from dopt.errors import SpecificationError
from dopt.reference.batch import BatchSteps, Lockstep
from dopt.spec.trial import TrialSpec
from dopt.systems.base import next_state

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
        parameters: Array = self._batch.theta[0].numpy()
        return parameters

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet."""
        states: Array = self._batch.states[0].numpy()
        return states


class ReferenceSteps:
    """The steps of a trial one by one: the caller says what state a plant has and what follows.

    The states and the inputs are theirs to write.
    """

    evidence: ClassVar[None] = None

    @torch.no_grad()
    def __init__(self, spec: TrialSpec) -> None:
        self._spec, self._batch = spec, BatchSteps([spec])
        self.states: Array = self._batch.states[0].numpy()
        self.inputs: Array = self._batch.inputs[0].numpy()
        self.errors: Array = np.full(spec.system.horizon, np.nan)

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,)."""
        parameters: Array = self._batch.theta[0].numpy().copy()
        return parameters

    def begin(self, t: int, state: Array) -> None:
        """Let step t begin at a state, (d,), whatever came before it."""
        self.states[t] = state

    def replace(self, parameters: Array, constants: Array) -> None:
        """Do nothing: no learner that replaces parameters runs here."""

    def measure(self, t: int, measured: Array) -> None:
        """Write what was measured after step t: x_{t+1}, (d,)."""
        self.states[t + 1] = measured

    def reached(self, t: int, inputs: Array, seconds: Array) -> Array:
        """Return the state, (d,), predicted from x_t after inputs (n, m) held for times (n,)."""
        x: Array = self.states[t]
        integrator = self._spec.system.integrator
        for u, dt in zip(inputs, seconds, strict=True):
            x = next_state(integrator, functools.partial(self._rate, u), x, float(dt))
        return x

    def _rate(self, u: Array, x: Array) -> Array:
        """Return dx/dt of the model, (d,)."""
        system, model = self._spec.system, self._spec.model
        rate = np.array(system.known(tuple(x), tuple(u), system.parameters), dtype=float)
        learned = model.predict(system, self.parameters, x[None], u[None])[0]
        rate[list(system.learned_rows)] += learned
        return rate

    def note_asked(self, u: Array) -> None:
        """Limits, which count rates from this input, are not enforced here."""

    @torch.no_grad()
    def plan_input(self, t: int) -> None:
        """Write the input u_t that the policy chooses at x_t."""
        self._batch.inputs[:, t] = self._batch.plan(t)

    @torch.no_grad()
    def take_in(self, t: int, dt: float) -> bool:
        """Learn from x_t, u_t and x_{t+1}, which came dt seconds later.

        Returns whether the parameters are finite.
        """
        self._batch.observe(t, dt)
        self.errors[t] = self._prediction_error(t)
        self._batch.learn(t)
        self._batch.inform(t)
        return bool(self._batch.theta.isfinite().all())

    def _prediction_error(self, t: int) -> float:
        """Return ‖y_t - a_θ(x_t)‖ before it is learned."""
        batch = self._batch
        predicted = batch.model(batch.theta, batch.sampled_states[:, t : t + 1])
        return float(torch.linalg.vector_norm(batch.targets[0, t] - predicted[0, 0]))
