"""Runs of a trial in the compiled kernel, whole or in pieces."""

from __future__ import annotations

import functools
import time

import numpy as np

from dopt.control.task import Feedback
from dopt.errors import SpecificationError
from dopt.kernel.from_spec import KernelState, points_of_trial, shared_points
from dopt.kernel.held import HeldTrial
from dopt.kernel.pointers import Compiled, compiled_trial
from dopt.kernel.steps import SteppedTrial, is_stepped
from dopt.policies.base import CompiledPolicy, check_norms
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from dopt.types import Array

FIRST_STEPS = 300
"""Steps of a trial before it is known what a step costs; trials of the paper have no more."""

PIECE_SECONDS = 1.0
"""Interval at which compiled code comes back to the interpreter, which can then heed a signal."""


class KernelTrial(KernelState):
    """A simulated trial, which can be advanced in pieces and looked at in between.

    Attributes
    ----------
    points : Evaluation
        Points at which the model is compared with the truth.
    done : int
        Number of steps done.
    diverged_at : int or None
        Step at which the trial diverged.
    feedback : Feedback or None
        The law of feedback that the policy has learned.
    """

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        shared = shared_points(spec.config)
        self.points = points_of_trial(shared, self.trial.network)
        self.done = 0
        self.diverged_at: int | None = None
        self.feedback: Feedback | None = None  # no compiled policy learns one

    @functools.cached_property
    def _code(self) -> Compiled:
        return compiled_trial(self.spec.policy, self.spec.learner, self.trial, self.points)

    @functools.cached_property
    def held(self) -> HeldTrial:
        """The trial as compiled code holds it."""
        return self._code.hold(self.trial, self._code.steps)

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged.

        Raises
        ------
        SpecificationError
            If ``last`` lies beyond the horizon.
        """
        if last > self.spec.system.horizon:
            raise SpecificationError(
                f"step {last} was asked for, but the horizon is {self.spec.system.horizon}: raise "
                f"env.horizon."
            )
        if self.diverged_at is not None or last <= self.done:
            return
        before = self.done
        while self.done < last and self.diverged_at is None:
            stop = min(last, self.evidence.due) if self.evidence else last
            self.done = self._code.advance(self.held, self.points, self.done, stop)
            if self.done < stop:
                self.diverged_at = self.done
            elif self.evidence and self.done == self.evidence.due:
                self.record.learn_us[self.done - 1] += self.evidence.fit(self.points)
        _check_inputs(self.spec, self.record.inputs, before, self.done)


def _check_inputs(spec: TrialSpec, inputs: Array, first: int, last: int) -> None:
    """Refuse inputs larger than γ from a compiled policy in a user's file."""
    if isinstance(spec.policy, CompiledPolicy):
        check_norms(spec.policy.name, inputs[first:last], first, spec.system.gamma)


def run_trial_in_kernel(spec: TrialSpec) -> TrialResult:
    """Run a whole trial in compiled code."""
    wall, cpu = time.perf_counter(), time.process_time()
    trial = trial_in_kernel(spec)
    checkpoints: dict[int, Array] = {}
    feedbacks: dict[int, Feedback] = {}
    for step in spec.assessed_steps:
        _advance_in_pieces(trial, step)
        if trial.diverged_at is None:
            checkpoints[step] = trial.parameters
            if (feedback := trial.feedback) is not None:
                feedbacks[step] = feedback
    _advance_in_pieces(trial, spec.system.horizon)
    record, end = trial.record, trial.diverged_at
    if end is not None:
        for rows in record:
            rows[end:] = np.nan
    columns = record._asdict()
    columns["states"] = columns.pop("true_states")
    if spec.system.n_measured:
        columns["estimated_states"] = record.states
    return TrialResult(
        **columns,
        parameters=trial.parameters,
        diverged_at=end,
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        checkpoints=checkpoints,
        feedbacks=feedbacks,
    )


def trial_in_kernel(spec: TrialSpec) -> KernelTrial | SteppedTrial:
    """Return a trial before its first step."""
    return SteppedTrial(spec) if is_stepped(spec.config) else KernelTrial(spec)


def _advance_in_pieces(trial: KernelTrial | SteppedTrial, last: int) -> None:
    """Run a trial up to a step; the numbers do not depend on where it is cut."""
    steps = FIRST_STEPS
    while trial.done < last and trial.diverged_at is None:
        before, start = trial.done, time.perf_counter()
        trial.advance(min(last, before + steps))
        rate = (trial.done - before) / (time.perf_counter() - start)
        steps = max(1, int(rate * PIECE_SECONDS))
