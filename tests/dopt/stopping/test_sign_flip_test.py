"""The group-sequential test keeps its level over all looks, and is the signed-rank test at one."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchmarks.adaptive_seeds import SHAPES, rejections
from dopt.stopping.looks import looks
from dopt.stopping.sign_flip_test import SignFlipTest

Array = npt.NDArray[np.float64]

STUDIES = 2_000
FEW = 499


def first_rejection(differences: Array, level: float, flips: int = FEW) -> int | None:
    """Return the number of seeds after which the test rejects."""
    test = SignFlipTest(flips)
    for n in looks(len(differences)):
        test.look(differences[:n], n / len(differences))
        if test.rejects(level):
            return n
    return None


def test_the_level_holds_over_all_looks_in_2000_skewed_studies() -> None:
    found = rejections(SHAPES["skewed"], STUDIES)
    error = 3 * np.sqrt(0.05 * 0.95 / STUDIES)
    assert found.value <= 0.05 + error
    assert found.value >= 0.05 - error, "the level is used up, or the test would find less"


@pytest.mark.parametrize(("shape", "missing"), [("heavy tails", 0.0), ("exponential", 0.2)])
def test_the_level_holds_with_heavy_tails_and_without_some_pairs(
    shape: str, missing: float
) -> None:
    found = rejections(SHAPES[shape], 500, missing=missing, seed=1)
    assert found.value <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 500)


def test_repeated_signed_rank_tests_would_be_found_out() -> None:
    """The bound above is one that the usual p after each batch does not keep."""
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(300):
        differences = np.subtract(*rng.gumbel(size=(2, 100)))
        wrong += any(stats.wilcoxon(differences[:n]).pvalue <= 0.05 for n in looks(100))
    assert wrong / 300 > 0.05 + 3 * np.sqrt(0.05 * 0.95 / 300)


def test_the_level_holds_for_the_signs_of_given_sizes() -> None:
    """Every assignment of signs to eleven sizes, two of them equal: the condition of the proof."""
    sizes = np.array([3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0, 8.0, 7.0, 0.5])
    level = 0.1
    rejected = []
    for signs in itertools.product((-1.0, 1.0), repeat=len(sizes)):
        test = SignFlipTest(9_999)
        for n in (7, 9, 11):
            test.look(sizes[:n] * signs[:n], n / 11)
        rejected.append(test.rejects(level))
    assert 0.5 * level < np.mean(rejected) <= level + 0.005  # of 9,999 random vectors


@pytest.mark.parametrize("effect", [0.0, 0.3, 0.45, 0.6])
def test_a_single_look_is_the_signed_rank_test(effect: float) -> None:
    differences = np.random.default_rng(5).standard_normal(30) + effect
    p_value = stats.wilcoxon(differences).pvalue
    test = SignFlipTest(99_999)
    test.look(differences, 1.0)
    assert test.rejects(1.1 * p_value + 1e-4)
    assert not test.rejects(0.9 * p_value - 1e-4)


@settings(deadline=None, max_examples=40)
@given(
    differences=st.lists(st.sampled_from([-3.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 5.0, np.inf]),
                         min_size=12, max_size=40),
    levels=st.tuples(st.floats(0.001, 0.5), st.floats(0.001, 0.5)),
)  # fmt: skip
def test_a_higher_level_rejects_no_later(
    differences: list[float], levels: tuple[float, float]
) -> None:
    low, high = (first_rejection(np.array(differences), level) for level in sorted(levels))
    assert low is None or (high is not None and high <= low)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), effect=st.floats(0.0, 1.0))
def test_only_signs_and_ranks_count(seed: int, effect: float) -> None:
    """The scale does not matter, nor which of the two is the reference, nor later seeds."""
    differences = np.random.default_rng(seed).standard_normal(50) + effect
    found = first_rejection(differences, 0.05)
    assert first_rejection(-differences, 0.05) == found
    assert first_rejection(7.0 * differences, 0.05) == found
    if found is not None:
        later = differences.copy()
        later[found:] = np.nan
        assert first_rejection(later, 0.05) == found


def test_a_lost_loss_counts_as_the_largest_difference_and_a_missing_one_as_none() -> None:
    assert first_rejection(np.full(20, np.inf), 0.05) == 10
    assert first_rejection(np.full(20, np.nan), 0.9) is None
    assert first_rejection(np.zeros(20), 0.9) is None
