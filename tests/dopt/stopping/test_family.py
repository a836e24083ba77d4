"""Decisions about many comparisons: Holm's procedure, and its error rate over all looks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchmarks.adaptive_seeds import SHAPES, decisions, wrong_studies
from dopt.stopping.family import newly_decided
from dopt.stopping.sign_flip_test import SignFlipTest


def test_few_studies_have_a_wrong_decision() -> None:
    """Eight comparisons with one reference, half of which differ: at most 5 % of the studies."""
    found = wrong_studies(SHAPES["skewed"], 200, comparisons=8)
    assert found.value <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)


def test_comparisons_that_differ_much_are_decided_early_and_the_others_never() -> None:
    rng = np.random.default_rng(0)
    effects = np.array([0.0, 1.5, -1.5])
    used = decisions(rng.standard_normal((3, 100)) + effects[:, None])
    assert used[0] is None
    assert all(n is not None and n <= 40 for n in used[1:])


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_one_look_is_holms_procedure_on_signed_rank_tests(seed: int) -> None:
    rng = np.random.default_rng(seed)
    differences = rng.standard_normal((6, 40)) + rng.uniform(0, 0.8, (6, 1))
    p_values = np.array([stats.wilcoxon(one).pvalue for one in differences])
    tests = {}
    for row, one in enumerate(differences):
        tests[row] = SignFlipTest(19_999)
        tests[row].look(one, 1.0)
    decided = newly_decided(tests)
    assert _holm(p_values * 1.25 + 2e-4) <= decided <= _holm(p_values * 0.8 - 2e-4)


def _holm(p_values: npt.NDArray[np.float64]) -> set[int]:
    """Return what Holm's procedure rejects at 0.05."""
    order = np.argsort(p_values)
    rejected = set()
    for place, row in enumerate(order):
        if p_values[row] > 0.05 / (len(p_values) - place):
            break
        rejected.add(int(row))
    return rejected


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_what_is_decided_stays_decided_with_more_seeds(seed: int) -> None:
    """A comparison that is decided after n of 60 seeds is so whatever the others do later."""
    rng = np.random.default_rng(seed)
    differences = rng.standard_normal((4, 60)) + rng.uniform(0, 1, (4, 1))
    used = decisions(differences, flips=499)
    for row, n in enumerate(used):
        changed = differences.copy()
        changed[:, n:] = np.nan
        if n is not None:
            assert decisions(changed, flips=499)[row] == n
