"""Run one trial of Algorithm 1: online neural exploration."""

from __future__ import annotations

import dataclasses
from typing import Literal

from dopt.assessment import assessed
from dopt.errors import SpecificationError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec

Path = Literal["kernel", "reference"]


def run_trial(spec: TrialSpec, path: Path | None = None) -> TrialResult:
    """Run a trial and assess it; its numbers depend on nothing but its specification.

    Parameters
    ----------
    spec : TrialSpec
        Trial to run.
    path : {"kernel", "reference"}, optional
        Compiled kernel or torch reference, in place of what the specification says.

    Returns
    -------
    TrialResult
        Losses, trajectory, timings and final parameters, as numpy arrays.

    Raises
    ------
    SpecificationError
        If that path cannot run the trial, or the specification is none.
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
