"""Trials whose steps the interpreter takes one by one: of systems without equations, for example.

It steps the environment of a black box, and it calls a plan or an update that is written in numpy,
between compiled steps.
"""

from __future__ import annotations

import numpy as np

from dopt.control.task import Feedback
from dopt.kernel.evaluation_points import points_of_trial
from dopt.kernel.from_spec import shared_points
from dopt.kernel.loop import act_next, evaluate_next
from dopt.kernel.numpy_parts import NumpyParts
from dopt.kernel.pointers import compiled_evaluation, compiled_step
from dopt.kernel.steps import KernelSteps
from dopt.policies.base import CompiledPolicy, check_norms
from dopt.randomness import episode_seed
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import BlackBox, new_start


def is_stepped(spec: TrialSpec) -> bool:
    """Return whether the interpreter takes the steps of a trial one by one."""
    return isinstance(spec.system, BlackBox) or NumpyParts.needed_by(spec.config)


class SteppedTrial(KernelSteps):
    """A trial in steps, with the attributes of :class:`dopt.kernel.run.KernelTrial`."""

    also_called = (evaluate_next,)

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        shared = shared_points(spec.config)
        self.points = points_of_trial(shared, self.trial.network, spec.system.horizon)
        self.done = 0
        self.diverged_at: int | None = None
        self._evaluate = compiled_evaluation(self.trial, self.points)
        self._episode = None
        if isinstance(spec.system, BlackBox):
            self._episode = spec.system.episode(episode_seed(spec.seed))
            self.begin(0, self._episode.state)
        else:
            self._act = compiled_step(self.trial, act_next)

    @property
    def feedback(self) -> Feedback | None:
        """The law of feedback that the policy has learned; None where it learns none."""
        return self._parts.feedback if self._parts else None

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged."""
        while self.done < last and self.diverged_at is None:
            if self._step(self.done):
                self.done += 1
            else:
                self.diverged_at = self.done

    def _step(self, t: int) -> bool:
        """Take step t, and return whether the trial goes on."""
        self.plan_input(t)
        if isinstance(self.spec.policy, CompiledPolicy):
            check_norms(self.spec.policy.name, self.inputs[t : t + 1], t, self.spec.system.gamma)
        inside, dt = self._go_on(t), self.spec.system.dt
        return inside and self.take_in(t, dt) and self._evaluate(self._held, self.points, t)

    def _go_on(self, t: int) -> bool:
        """Let the system go on to x_{t+1}, and return whether that is within its limit."""
        if self._episode is None:
            return bool(self._act(self._held, t))
        self.inputs[t] = self._episode.step(self.inputs[t].copy())
        if (start := new_start(self._episode)) is not None:
            self.begin(t, start)
        following = self.record.states[t + 1]
        following[:] = self._episode.state
        return bool(np.all(np.abs(following) <= self.spec.system.state_limit))  # false for NaN
