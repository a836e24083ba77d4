"""The savings on the claims are those of the page, and the question prints what it simulates."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import adaptive_seeds
from benchmarks.adaptive_seeds import SHAPES, claimed_losses, claims, rejections


def test_two_in_five_trials_of_the_claims_are_saved_and_the_verdicts_stay() -> None:
    found = claims()
    assert len(found) == 42
    run = sum(claim.seeds or 100 for claim in found)
    run += sum(max(c.seeds or 100 for c in found if c.env == e) for e in {c.env for c in found})
    assert run == 2_170
    assert run <= 0.6 * 4_600
    others = [(claim.env, claim.variant) for claim in found if not claim.agrees]
    assert others == [("quadrotor", "look-ahead, budget_us=250")], "its plans depend on the clock"


def test_the_losses_are_those_of_the_report() -> None:
    """Where they do not depend on the clock, nor amplify rounding as the Kalman filter does."""
    published = {
        (row["env"], row["variant"]): float(row["loss"])
        for row in adaptive_seeds._rows("comparisons.csv")
    }
    for name, losses in claimed_losses().items():
        if "ekf" in name[1] or "budget" in name[1] or np.isnan(losses).any():
            continue
        assert np.mean(losses) == pytest.approx(published[name], rel=1e-6), name


def test_a_difference_is_found_more_often_the_larger_it_is() -> None:
    powers = [rejections(SHAPES["skewed"], 60, effect).value for effect in (0.0, 0.4, 1.0)]
    assert powers == sorted(powers)
    assert powers[0] < 0.2
    assert powers[-1] > 0.95


def test_the_interval_covers_with_losses_as_the_claims_have_them() -> None:
    found = [share.value for share in adaptive_seeds.resampled_coverages(200).values()]
    assert len(found) == 38
    assert np.mean(found) >= 0.95
    assert min(found) >= 0.95 - 4 * np.sqrt(0.05 * 0.95 / 200)


def test_the_question_has_a_row_for_each_simulation() -> None:
    rows = adaptive_seeds.measure(quick=True)
    assert len(rows) == 4 + 1 + 4 + 6 + 17 + 2
    assert all(row.value is not None and 0 <= row.value <= 1 for row in rows)
