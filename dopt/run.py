"""Run of a trial on its execution path, and its repetition with the states and weights kept."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from dopt.assessment import assessed
from dopt.errors import SpecificationError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from dopt.types import Array

Path = Literal["kernel", "reference"]


def run_trial(spec: TrialSpec, path: Path | None = None) -> TrialResult:
    """Run a trial and assess it; its numbers depend on nothing but its specification.

    Parameters
    ----------
    spec : TrialSpec
        Trial to run.
    path : {"kernel", "reference"}, optional
        Compiled kernel or torch, in place of what the specification says.

    Returns
    -------
    TrialResult
        Losses, trajectory, timings and final parameters, as numpy arrays.

    Raises
    ------
    SpecificationError
        If that path cannot run the trial, or ``spec`` is not a TrialSpec.
    """
    if not isinstance(spec, TrialSpec):
        raise SpecificationError(
            f"run_trial was given {spec!r}, but a TrialSpec is expected: make one with "
            f"TrialSpec.from_names or TrialSpec.of_system."
        )
    if path is not None:
        spec = dataclasses.replace(spec, config=dataclasses.replace(spec.config, path=path))
    if spec.config.path == "reference":
        from dopt.reference.batch import run_trials

        return assessed(spec, run_trials([spec])[0])
    from dopt.kernel.run import run_trial_in_kernel

    return assessed(spec, run_trial_in_kernel(spec))


@dataclass(frozen=True)
class Rerun:
    """States of a trial, and the model's parameters after chosen steps.

    Attributes
    ----------
    steps : (k,)
        Numbers of steps done, none past a divergence.
    parameters : (k, q)
        Parameters of the model after each of them.
    states : (T + 1, d)
        All states, to compare with stored ones; NaN from the step of a divergence on, as there.
    """

    steps: npt.NDArray[np.int64]
    parameters: Array
    states: Array


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
    seen, states = (_seen_in_torch if spec.config.path == "reference" else _seen)(spec, steps)
    parameters = np.array([*seen.values()]).reshape(-1, spec.model.n_parameters(spec.system))
    return Rerun(np.array([*seen], dtype=np.int64), parameters, states)


def _seen(spec: TrialSpec, steps: Sequence[int]) -> tuple[Mapping[int, Array], Array]:
    """Return the parameters after each step that is reached, and the states."""
    from dopt.kernel.run import trial_in_kernel

    trial, seen = trial_in_kernel(spec), dict[int, Array]()
    for step in steps:
        trial.advance(step)
        if trial.diverged_at is not None:
            break
        seen[step] = trial.parameters.copy()
    states = trial.states.copy()
    if trial.diverged_at is not None:
        states[trial.diverged_at :] = np.nan
    return seen, states


def _seen_in_torch(spec: TrialSpec, steps: Sequence[int]) -> tuple[Mapping[int, Array], Array]:
    from dopt.reference.batch import run_trials

    if steps and steps[-1] > spec.system.horizon:
        raise SpecificationError(
            f"step {steps[-1]} was asked for, but the horizon is {spec.system.horizon}: raise "
            f"env.horizon."
        )
    result = run_trials([spec], noted=steps)[0]
    return result.checkpoints, result.states
