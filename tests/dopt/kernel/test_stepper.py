"""A trial comes back to the interpreter now and then, and its numbers do not show where."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.kernel import run
from dopt.kernel.run import KernelTrial, run_trial_in_kernel
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial

CASES = [
    trial("pendulum", "d_optimal", 1, env={"horizon": 60}),
    trial("quadrotor", "d_optimal", 1, env={"horizon": 60}, policy={"form": "dual"}),
    trial("arm", "d_optimal", 1, env={"horizon": 60}, policy={"form": "sketch"}),
    trial("cartpole", "uniform", 1, env={"horizon": 60}),
]


@pytest.mark.parametrize("spec", CASES, ids=lambda spec: spec.system.name)
def test_the_numbers_do_not_depend_on_the_pieces(
    spec: TrialSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run_trial_in_kernel(spec)
    lasts: list[int] = []
    advance = KernelTrial.advance

    def noted(trial: KernelTrial, last: int) -> None:
        lasts.append(last)
        advance(trial, last)

    monkeypatch.setattr(KernelTrial, "advance", noted)
    monkeypatch.setattr(run, "FIRST_STEPS", 7)
    monkeypatch.setattr(run, "PIECE_SECONDS", 1e-9)
    pieces = run_trial_in_kernel(spec)
    assert lasts == [*range(7, 61)]
    for name in ("loss", "reachable_loss", "states", "inputs", "parameters"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
