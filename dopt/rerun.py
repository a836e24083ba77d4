"""Rerun of a trial that returns the model's parameters after chosen steps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.spec.trial import TrialSpec

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Rerun:
    """States of a trial, and the model's parameters after chosen steps.

    Attributes
    ----------
    steps : (k,)
        Numbers of steps done; past a divergence there are none.
    parameters : (k, q)
        Parameters of the model after each of them.
    states : (T + 1, d)
        All states, to compare with stored ones; NaN from the step of a divergence on, as there.
    """

    steps: npt.NDArray[np.int64]
    parameters: Array
    states: Array


class Run(Protocol):
    """A trial that can be advanced in pieces and looked at in between."""

    @property
    def diverged_at(self) -> int | None: ...
    @property
    def parameters(self) -> Array: ...
    @property
    def states(self) -> Array: ...
    def advance(self, last: int) -> None: ...


def rerun(spec: TrialSpec, steps: Sequence[int]) -> Rerun:
    """Run a trial on its path and note the parameters after ascending numbers of steps.

    Raises
    ------
    SpecificationError
        If the numbers do not ascend, or are not of the trial's steps.
    """
    if any(a >= b for a, b in itertools.pairwise(steps)):
        raise SpecificationError(f"the steps {list(steps)} do not ascend: sort them.")
    if steps and steps[0] < 0:
        raise SpecificationError(f"step {steps[0]} was asked for, but the first is 0: begin there.")
    trial = _run(spec)
    seen: list[int] = []
    parameters: list[Array] = []
    for step in steps:
        trial.advance(step)
        if trial.diverged_at is not None:
            break
        seen.append(step)
        parameters.append(trial.parameters.copy())
    states = trial.states.copy()
    if trial.diverged_at is not None:
        states[trial.diverged_at :] = np.nan
    q = spec.model.n_parameters(spec.system)
    return Rerun(np.array(seen, dtype=np.int64), np.array(parameters).reshape(-1, q), states)


def _run(spec: TrialSpec) -> Run:
    if spec.config.path == "reference":
        from dopt.reference.stepper import ReferenceTrial

        return ReferenceTrial(spec)
    from dopt.kernel.run import trial_in_kernel

    return trial_in_kernel(spec)
