"""Steps of a trial one by one, and the parameters after each."""

from __future__ import annotations

import numpy as np
from numba import float64, int64

from dopt.kernel.held import HeldTrial, trial_in
from dopt.kernel.loop import advance
from dopt.kernel.pointers import compiled_for, held_kind, kind_of, path_of
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Evaluation
from dopt.types import Matrix
from tests.dopt.newcomers import kept


@kept
def record(held: HeldTrial, points: Evaluation, first: int, parameters: Matrix) -> int:
    for i in range(parameters.shape[0]):
        done = advance(held, points, first + i, first + i + 1)
        if done <= first + i:
            return done
        parameters[i] = trial_in(held).state.theta
    return first + parameters.shape[0]


def run(fast: KernelTrial, steps: int) -> np.ndarray:
    """Take steps one by one; return the parameters after each, (steps, q).

    Compiled code calls the loop: from Python, each call would take as long as a step.
    """
    parameters = np.empty((steps, len(fast.state.theta)))
    kinds = (held_kind(fast.trial), kind_of(fast.points), int64, float64[:, ::1])
    last = fast.done + steps
    fast.done = compiled_for(path_of(record), record, kinds)(
        fast.held, fast.points, fast.done, parameters
    )
    assert fast.done == last, "the trial has diverged"
    return parameters
