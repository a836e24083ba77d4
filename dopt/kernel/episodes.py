"""Trials of systems without equations: the interpreter steps them between two compiled steps."""

from __future__ import annotations

import numpy as np

from dopt.kernel.evaluation_points import points_of_trial
from dopt.kernel.from_spec import shared_points
from dopt.kernel.loop import evaluate_next
from dopt.kernel.pointers import compiled_evaluation
from dopt.kernel.steps import KernelSteps
from dopt.policies.base import CompiledPolicy, check_norms
from dopt.randomness import episode_seed
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import BlackBox


class EpisodeTrial(KernelSteps):
    """A trial of a black box, with the attributes of :class:`dopt.kernel.run.KernelTrial`."""

    also_called = (evaluate_next,)

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        shared = shared_points(spec.config)
        self.points = points_of_trial(shared, self.trial.network, spec.system.horizon)
        self.done = 0
        self.diverged_at: int | None = None
        self._evaluate = compiled_evaluation(self.trial, self.points)
        assert isinstance(spec.system, BlackBox)
        self._episode = spec.system.episode(episode_seed(spec.seed))
        self.begin(0, self._episode.state)

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged."""
        while self.done < last and self.diverged_at is None:
            if self._step(self.done):
                self.done += 1
            else:
                self.diverged_at = self.done

    def _step(self, t: int) -> bool:
        """Take step t, and return whether the trial goes on."""
        system, following = self.spec.system, self.record.states[t + 1]
        self.plan_input(t)
        if isinstance(self.spec.policy, CompiledPolicy):
            check_norms(self.spec.policy.name, self.inputs[t : t + 1], t, system.gamma)
        self.inputs[t] = self._episode.step(self.inputs[t].copy())
        following[:] = self._episode.state
        inside = bool(np.all(np.abs(following) <= system.state_limit))  # false for NaN
        return inside and self.take_in(t, system.dt) and self._evaluate(self._held, self.points, t)
