"""Trials on another processor: the same bits with registers of half the width."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.paths import ROOT

PROGRAM = """
import hashlib
import numpy as np
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
digest = hashlib.sha256()
for env in ("pendulum", "cartpole", "arm", "quadrotor"):
    for learner in ("adam", "adam_window"):
        spec = TrialSpec.from_names({"name": env, "horizon": 120}, "d_optimal", learner=learner)
        result = run_trial(spec.with_seed(3))
        for values in (result.inputs, result.states, result.loss, result.parameters):
            digest.update(np.ascontiguousarray(values).tobytes())
print(digest.hexdigest())
"""


def digest_on(processor: str | None) -> str:
    """Return a digest of all numbers of some trials; None: on this processor."""
    forced = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""} if processor else {}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **forced, "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return done.stdout.strip()


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="the other processor is x86-64 too")
def test_a_trial_has_the_same_bits_with_short_registers() -> None:
    assert digest_on("x86-64-v3") == digest_on(None)
