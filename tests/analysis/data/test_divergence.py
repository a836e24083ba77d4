from __future__ import annotations

import numpy as np
import pytest

from analysis.data.divergence import DivergenceRule, apply_rule

NAN = np.nan
SEEDS = np.array([0, 1, 2, 3])
VALUES = np.array([[4.0, 2.0], [6.0, 8.0], [5.0, NAN], [5.0, 5.0]])
DIVERGED = np.array([False, False, True, False])


def test_a_diverged_trial_leaves_its_whole_curve() -> None:
    sample = apply_rule(SEEDS, VALUES, DIVERGED, DivergenceRule.EXCLUDE)
    assert sample.seeds.tolist() == [0, 1, 3]
    assert sample.values.tolist() == [[4, 2], [6, 8], [5, 5]]
    assert sample.describe() == "3/4, 1 diverged"


@pytest.mark.parametrize(
    ("rule", "lent"), [(DivergenceRule.WORST, [6, 8]), (DivergenceRule.MEDIAN, [5, 5])]
)
def test_the_others_lend_a_value_at_every_step(rule: DivergenceRule, lent: list[float]) -> None:
    sample = apply_rule(SEEDS, VALUES, DIVERGED, rule)
    assert sample.values[2].tolist() == lent
    assert np.array_equal(sample.values[[0, 1, 3]], VALUES[[0, 1, 3]])
    assert sample.n_diverged == 1


@pytest.mark.parametrize("rule", list(DivergenceRule))
def test_without_survivors_the_sample_is_empty(rule: DivergenceRule) -> None:
    sample = apply_rule(SEEDS, VALUES, np.full(4, True), rule)
    assert sample.values.shape == (0, 2)
    assert sample.describe() == "0/4, 4 diverged"


def test_without_divergence_the_count_is_a_number() -> None:
    kept = ~DIVERGED
    sample = apply_rule(SEEDS[kept], VALUES[kept], DIVERGED[kept], DivergenceRule.WORST)
    assert sample.describe() == "3"
