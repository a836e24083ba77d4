"""The process that fits beside an exploration: requests come in, and what was found goes out."""

from __future__ import annotations

import contextlib
import os
import pickle
import sys
from typing import Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.explorer.refit import Found
from dopt.fitting.fit import fit
from dopt.kernel import learners
from dopt.kernel.evidence import Request, Samples, fit_rows, renewed
from dopt.log import Log
from dopt.systems.plant import Plant
from dopt.types import Array

WEIGHTS = (30.0, 10.0, 3.0, 1.0)
"""Weights s that the fits try (:func:`dopt.fit`)."""


MOST_STEPS = 50
"""Steps of a fit of a network to its samples."""


def _answer(request: Any) -> Found | Array | Samples:
    """Return what a fit finds, for a :data:`dopt.explorer.refit.FitRequest`."""
    if isinstance(request, Request):
        return fit_rows(request)
    if isinstance(request[0], Samples):
        return renewed(*request)
    if isinstance(request[0], Plant):
        return _found(*request)
    problem: learners.Problem = request[0]
    theta: Array = request[1]
    learners.fit(problem, theta, MOST_STEPS)
    return theta


def _found(plant: Plant, log: Log, width: int, seed: int) -> Found:
    found = fit(plant, log, width=width, seed=seed, weights=WEIGHTS, workers=1)
    chosen = found.chosen
    values, s = chosen.model.values(chosen.solution.p), chosen.model.structure
    layout = s.feature_centers, s.feature_scales, values.sizes
    weights = np.empty(0)
    if chosen.model.width:
        weights = np.concatenate([part.ravel() for part in chosen.model.matrices(values.weights)])
    numbers = values.constants, values.delay, values.lag, weights
    return Found(*numbers, *layout, found.plant.supply)


def serve() -> None:
    """Answer requests from the standard input until it ends."""
    with contextlib.suppress(AttributeError, OSError):  # which Windows lacks
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # also where that is urgent
        os.nice(10)  # the exploration comes first
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed does not mix with them
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)  # of the process that began this
        except EOFError:
            return
        try:
            answer: Found | Array | Samples | str = _answer(request)
        except (SpecificationError, ArithmeticError, np.linalg.LinAlgError) as error:
            answer = str(error)
        try:
            pickle.dump(answer, answers, protocol=5)  # whose arrays are read without a copy
            answers.flush()
        except BrokenPipeError:  # the exploration has ended
            os._exit(0)  # without another attempt to flush
