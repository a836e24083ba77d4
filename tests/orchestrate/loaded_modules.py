"""Run function that reports which modules its process has loaded."""

from __future__ import annotations

import sys

from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec


def report_modules(spec: TrialSpec) -> TrialResult:
    """Run the trial, then fail with the names of the top-level modules."""
    run_trial(spec)
    raise RuntimeError(" ".join(sorted({name.split(".")[0] for name in sys.modules})))
