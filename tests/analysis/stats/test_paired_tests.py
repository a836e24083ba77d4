from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.stats.intervals import (
    MOST_BOOTSTRAP_VALUES,
    interval_of_mean,
    standard_error,
    student_quantile,
)
from analysis.stats.paired_tests import (
    benjamini_hochberg,
    compare,
    signed_rank,
    without_ratio,
)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_ratio_is_the_geometric_mean_of_the_pairs() -> None:
    found = compare(np.array([1.0, 8.0]), np.array([4.0, 4.0]), rng())
    assert found.ratio == pytest.approx(math.sqrt(0.25 * 2))
    assert found.improvement == 0.5
    assert found.n_pairs == 2


def test_a_constant_factor_is_found_without_spread() -> None:
    baseline = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    found = compare(baseline / 2, baseline, rng())
    assert found.ratio == pytest.approx(0.5)
    assert (found.low, found.high) == pytest.approx((0.5, 0.5))
    assert found.improvement == 1.0
    assert found.p_value == pytest.approx(2 / 2**5)  # exact: all five signs agree


def test_values_that_differ_by_rounding_have_no_spread() -> None:
    values = np.full(100, -1.0)
    values[:50] = np.nextafter(-1.0, 0.0)
    assert interval_of_mean(values, rng()) == pytest.approx((-1.0, -1.0), rel=1e-12)


def test_what_was_lost_is_the_worst_in_the_test_and_in_no_ratio() -> None:
    ours = np.array([1.0, 2.0, np.inf, 4.0, np.inf, np.nan, 1.0])
    theirs = np.array([2.0, 4.0, 1.0, 1.0, np.inf, 1.0, np.nan])
    found = compare(ours, theirs, rng())
    assert found.n_pairs == 5  # but those of which nothing is known
    assert without_ratio(ours, theirs) == 4
    assert found.ratio == pytest.approx(1.0)  # 1/2 · 1/2 · 4
    assert found.improvement == (2 + 0.5) / 5
    largest = np.log([1 / 2, 1 / 2, 1e9, 4.0, 1.0])
    assert found.p_value == pytest.approx(signed_rank(largest))
    nothing = compare(np.full(8, np.inf), np.arange(1.0, 9.0), rng())
    assert math.isnan(nothing.ratio)
    assert nothing.p_value == pytest.approx(2 / 2**8)


def test_equal_losses_are_no_difference() -> None:
    losses = np.array([1.0, 2.0, 3.0])
    found = compare(losses, losses, rng())
    assert (found.ratio, found.p_value, found.improvement) == (1.0, 1.0, 0.5)


def test_swapping_the_policies_inverts_the_ratio() -> None:
    a, b = rng().lognormal(size=(2, 30))
    forth, back = compare(a, b, rng()), compare(b, a, rng())
    assert forth.ratio * back.ratio == pytest.approx(1)
    assert forth.p_value == pytest.approx(back.p_value)
    assert forth.improvement + back.improvement == pytest.approx(1)
    assert forth.low < forth.ratio < forth.high


def test_the_pairing_matters() -> None:
    seeds = rng().normal(scale=2.0, size=40)  # what both policies share of a seed
    a, b = np.exp(seeds + 0.1 * rng().normal(size=40) - 0.2), np.exp(seeds)
    paired, shuffled = compare(a, b, rng()), compare(a, np.roll(b, 7), rng())
    assert paired.ratio == pytest.approx(shuffled.ratio)
    assert paired.high - paired.low < 0.2 * (shuffled.high - shuffled.low)
    assert paired.p_value < 1e-3 < shuffled.p_value


def test_too_few_pairs_have_no_interval() -> None:
    none = compare(np.empty(0), np.empty(0), rng())
    assert none.n_pairs == 0
    assert math.isnan(none.ratio)
    one = compare(np.array([2.0]), np.array([1.0]), rng())
    assert one.ratio == pytest.approx(2.0)
    assert math.isnan(one.low)
    assert one.p_value == 1.0


def test_a_loss_of_zero_is_counted_but_has_no_ratio() -> None:
    found = compare(np.array([0.0, 0.0, 1.0, 3.0]), np.array([0.0, 1.0, 0.0, 4.0]), rng())
    assert found.improvement == (2 + 1 / 2) / 4
    assert found.n_pairs == 4
    assert np.isnan([found.ratio, found.low, found.high, found.p_value]).all()


def test_signed_rank_of_a_textbook_case() -> None:
    # ranks 1..6 with the smallest negative: W = 1, of 64 sign patterns 2 have W <= 1
    assert signed_rank(np.array([-1.0, 2, 3, 4, 5, 6])) == pytest.approx(2 * 2 / 64)


def test_the_bootstrap_covers_the_mean_about_as_often_as_it_says() -> None:
    repeats, n = 250, 30
    draws = np.random.default_rng(1).normal(loc=-0.5, size=(repeats, n))
    intervals = [interval_of_mean(values, np.random.default_rng(2)) for values in draws]
    covered = np.mean([low <= -0.5 <= high for low, high in intervals])
    assert 0.89 < covered < 0.985


@pytest.mark.parametrize("family", ["normal", "exponential"])
def test_the_interval_of_many_values_is_near_the_bootstrap(family: str) -> None:
    draw = getattr(np.random.default_rng(3), family)
    values = draw(size=MOST_BOOTSTRAP_VALUES + 1)
    half = student_quantile(MOST_BOOTSTRAP_VALUES) * float(standard_error(values))
    found = interval_of_mean(values, rng())
    assert found == pytest.approx((values.mean() - half, values.mean() + half), abs=1e-12)
    bootstrap = interval_of_mean(values[:-1], rng())
    np.testing.assert_allclose(found, bootstrap, atol=0.07 * half)
    assert found != pytest.approx(bootstrap, abs=1e-9)


def test_benjamini_hochberg_by_hand() -> None:
    # sorted p times m / rank, then the running minimum from the right
    assert benjamini_hochberg([0.01, 0.04, 0.03, 0.5]) == pytest.approx(
        [0.04, 0.16 / 3, 0.16 / 3, 0.5]
    )


def test_benjamini_hochberg_leaves_out_what_was_not_tested() -> None:
    adjusted = benjamini_hochberg([0.02, math.nan, 0.5])
    assert adjusted[0] == pytest.approx(0.04)
    assert math.isnan(adjusted[1])
    assert benjamini_hochberg([]) == []


@pytest.mark.parametrize("n", [3, 5, 8])
def test_the_interval_of_few_pairs_covers_as_often_as_it_says(n: int) -> None:
    repeats = 4000
    draws = np.random.default_rng(n).normal(loc=-0.5, size=(repeats, n))
    intervals = [interval_of_mean(values, rng()) for values in draws]
    covered = np.mean([low <= -0.5 <= high for low, high in intervals])
    assert covered == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / repeats))
