"""Run one trial of Algorithm 1: online neural exploration."""

from __future__ import annotations

from typing import Literal

from dopt.result import TrialResult
from dopt.spec import TrialSpec

Path = Literal["auto", "kernel", "reference"]


def run_trial(spec: TrialSpec, path: Path = "auto") -> TrialResult:
    """Run a trial; its numbers depend on nothing but its specification.

    Parameters
    ----------
    spec : TrialSpec
        What to run.
    path : {"auto", "kernel", "reference"}
        Compiled kernel or torch reference; "auto" takes the kernel, which covers every registered
        choice.
    """
    if path == "reference":
        from dopt.reference.lockstep import run_trials

        return run_trials([spec])[0]
    from dopt.kernel.run import run_trial_in_kernel

    return run_trial_in_kernel(spec)
