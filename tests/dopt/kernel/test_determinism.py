"""A trial's numbers depend on nothing but its specification."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from dopt.kernel.run import KernelTrial
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import PAIRS, trial
from tests.paths import ROOT

NUMBERS = ("loss", "reachable_loss", "states", "inputs", "parameters")


def numbers(result: TrialResult) -> bytes:
    return b"".join(getattr(result, name).tobytes() for name in NUMBERS)


@pytest.mark.parametrize("policy", sorted({policy for _, policy in PAIRS}))
def test_the_same_trial_gives_the_same_bits_whatever_ran_before(policy: str) -> None:
    """In every system, the second time after other systems than the first time."""
    specs = [trial(env, policy, 8) for env, one in PAIRS if one == policy]
    first = [numbers(run_trial(spec)) for spec in specs]
    run_trial(trial("arm", "d_optimal", 9, model={"width": 11}))
    run_trial(trial("quadrotor", "oracle", 10))
    for spec, expected in zip(reversed(specs), reversed(first), strict=True):
        again = numbers(run_trial(TrialSpec.from_mapping(spec.to_mapping())))
        assert again == expected, spec.system.name


@pytest.mark.parametrize("policy", ["random", "uniform", "d_optimal", "oracle"])
def test_a_trial_in_pieces_is_the_trial_at_once(policy: str) -> None:
    spec = trial("arm", policy, 3)
    whole, pieces = KernelTrial(spec), KernelTrial(spec)
    whole.advance(30)
    for last in (1, 2, 9, 9, 29, 30):
        pieces.advance(last)
        assert pieces.done == last
    for name in ("states", "inputs", "loss", "reachable_loss"):
        assert np.array_equal(getattr(whole.record, name), getattr(pieces.record, name)), name
    assert np.array_equal(whole.state.theta, pieces.state.theta)


def test_another_process_gives_the_same_bits() -> None:
    program = (
        "from tests.dopt.kernel.test_determinism import numbers, trial, run_trial\n"
        "print(numbers(run_trial(trial('cartpole', 'd_optimal', 8))).hex())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert bytes.fromhex(done.stdout) == numbers(run_trial(trial("cartpole", "d_optimal", 8)))


def test_another_seed_gives_another_trial() -> None:
    one, two = (run_trial(trial("arm", "d_optimal", seed)) for seed in (0, 1))
    assert not np.any(one.loss == two.loss)


def test_seeds_share_what_they_are_told_apart_by() -> None:
    """Trials of one configuration start from one state and are judged on the same points."""
    one, two = KernelTrial(trial("arm", "d_optimal", 0)), KernelTrial(trial("arm", "d_optimal", 1))
    assert one.trial[:3] == two.trial[:3]  # plant, network and algorithm: the same arrays
    assert one.points is two.points
    assert np.array_equal(one.record.states[0], two.record.states[0])
