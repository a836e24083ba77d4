"""What the long trials measure is the trial itself, without its evaluation."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.run import run_trial
from studies.speed import scaling


def test_the_steps_that_are_measured_are_the_trials() -> None:
    trial = scaling.Steps("cartpole", 8, 20, "sketch")
    assert trial.advance(20) > 0.0
    assert np.array_equal(trial.inputs, run_trial(trial.spec).inputs)


def test_each_tenth_has_a_row_with_the_record_so_far() -> None:
    rows = list(scaling.tenths("cartpole", 8, 20, "primal", "adam_window"))
    assert [row.size for row in rows] == list(range(1, 11))
    assert rows[-1].rows == pytest.approx(10 * rows[0].rows, rel=0.0, abs=1e-9)
    assert all(row.step_us > 0.0 and row.peak > 0.0 for row in rows)


def test_a_trial_that_diverges_is_said() -> None:
    trial = scaling.Steps("cartpole", 8, 20, "sketch")
    trial.trial.record.true_states[0] = np.inf
    with pytest.raises(RuntimeError, match="cartpole, width 8 diverged at step 0"):
        trial.advance(1)
