"""Steps of Algorithm 1 one by one, on a plant that is not simulated."""

from __future__ import annotations

from typing import ClassVar

from dopt.kernel.loop import learn_next, observe_next
from dopt.kernel.numpy_parts import NumpyParts
from dopt.kernel.pointers import BETWEEN, compiled_step, compiled_steps
from dopt.kernel.trial_state import KernelState
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import start_variances
from dopt.types import Array, CompiledFunction


class KernelSteps(KernelState):
    """The compiled steps of a trial: the caller says what state a plant has and what follows.

    The states and the inputs of the record are theirs to write.
    """

    also_called: ClassVar[tuple[CompiledFunction, ...]] = ()

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        if spec.system.n_measured:
            self.trial.sensors.start_variances[:] = start_variances(spec.system)
        in_numpy = NumpyParts.needed_by(spec.config)
        others = (*self.also_called, *(BETWEEN if in_numpy else ()))
        self._code = compiled_steps(spec.policy, spec.learner, self.trial, others)
        self._held = self._code.hold(self.trial, self._code.steps)
        self._parts: NumpyParts | None = None
        if in_numpy:
            self._parts = NumpyParts(spec, self.trial, self._held)
            self._observe = compiled_step(self.trial, observe_next)
            self._learn = compiled_step(self.trial, learn_next)

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, known or estimated, (T + 1, d)."""
        return self.record.states

    @property
    def inputs(self) -> Array:
        """Inputs u_0 ... u_{T-1}, (T, m)."""
        return self.record.inputs

    @property
    def errors(self) -> Array:
        """Errors of the accelerations before they were learned, (T,)."""
        return self.record.loss

    def begin(self, t: int, state: Array) -> None:
        """Let step t begin at a state, (d,), whatever came before it."""
        self.record.states[t] = state
        if len(self.state.estimate.starts):
            self.state.estimate.starts[t] = state

    def measure(self, t: int, measured: Array) -> None:
        """Write what was measured after step t: x_{t+1}, (d,), or the outputs, (n,)."""
        known = not self.spec.system.n_measured
        into = self.record.states[t + 1] if known else self.state.estimate.outputs[t]
        into[:] = measured

    def plan_input(self, t: int) -> None:
        """Write the input u_t that the policy chooses at x_t."""
        chosen_in = self._parts.choose(t, self.record.inputs[t]) if self._parts else 0.0
        self._code.plan_input(self._held, t)
        self.record.plan_us[t] += chosen_in

    def take_in(self, t: int, dt: float) -> bool:
        """Learn from x_t, u_t and x_{t+1}, which came dt seconds later.

        Returns whether the parameters are finite.
        """
        if self._parts is None:
            return bool(self._code.take_in(self._held, t, dt))
        target = self._parts.targets[t]
        self._observe(self._held, t, dt, target)
        updated_in = self._parts.update(t)
        finite = bool(self._learn(self._held, t, target))
        self.record.learn_us[t] += updated_in
        if finite:
            self.record.plan_us[t] += self._parts.note(t)
        return finite
