"""Steps of a trial one by one, and the parameters after each."""

from __future__ import annotations

import numpy as np
from numba import float64, int64

from dopt.kernel.loop import advance
from dopt.kernel.pointers import compiled_for, kind_of, path_of, pointer, signatures
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Evaluation, Trial
from dopt.types import CompiledFunction, Matrix
from tests.dopt.newcomers import kept


@kept
def record(
    trial: Trial,
    points: Evaluation,
    plan: CompiledFunction,
    learn: CompiledFunction,
    first: int,
    parameters: Matrix,
) -> int:
    for i in range(parameters.shape[0]):
        done = advance(trial, points, plan, learn, first + i, first + i + 1)
        if done <= first + i:
            return done
        parameters[i] = trial.state.theta
    return first + parameters.shape[0]


def run(fast: KernelTrial, steps: int) -> np.ndarray:
    """Take steps one by one; return the parameters after each, (steps, q).

    Compiled code calls the loop: from Python, each call would take as long as a step.
    """
    parameters = np.empty((steps, len(fast.state.theta)))
    code, given = fast._code, (fast.trial, fast.points)
    kinds = (*map(kind_of, given), *map(pointer, signatures(fast.trial)), int64, float64[:, ::1])
    taken = compiled_for(path_of(record), record, kinds)
    last = fast.done + steps
    fast.done = taken(*given, code.plan, code.learn, fast.done, parameters)
    assert fast.done == last, "the trial has diverged"
    return parameters
