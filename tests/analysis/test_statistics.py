"""Intervals, scores and paired tests, by their definitions and by other libraries."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from analysis.cli import main
from analysis.data.matching import AnalysisError, Filter
from analysis.data.selection import select
from analysis.stats.curves import (
    BAND_RESAMPLES,
    FEWEST_BAND_VALUES,
    MEAN_RESAMPLES,
    MOST_BOOTSTRAP_VALUES,
    Statistic,
    centre,
    geometric_mean,
    interval_of_mean,
    standard_error,
    stratified_mean,
    student_quantile,
)
from analysis.stats.curves import band as band_of
from analysis.stats.scores import (
    Measure,
    benjamini_hochberg,
    censored_median,
    compare,
    compare_hitting_times,
    first_passage,
    last_passage,
    mean_over_steps,
    on_front,
    sign_test,
    signed_rank,
    without_ratio,
)
from analysis.tables.comparisons import compare_policies, compare_steps
from analysis.tables.rendering import TextTable, hitting_times_table
from orchestrate.store import Reader
from tests.analysis.synthetic import fake_result, make_spec


def test_band_of_three_numbers_by_hand() -> None:
    band = band_of(np.array([[1.0], [2.0], [3.0]]))
    half = 4.302652729911275 / np.sqrt(3)  # t quantile of 2 degrees of freedom
    assert band.centre[0] == 2.0
    assert band.low[0] == pytest.approx(2 - half)
    assert band.high[0] == pytest.approx(2 + half)
    assert band.n == 3


def test_one_trial_has_a_mean_and_no_interval_and_none_gives_nan_without_a_warning() -> None:
    band = band_of(np.array([[4.0, 2.0]]))
    assert band.centre.tolist() == [4.0, 2.0]
    assert np.isnan([band.low, band.high]).all()
    assert np.isnan(band_of(np.empty((0, 3))).centre).all()
    assert np.isnan(centre(np.empty(0)))
    assert np.isnan(standard_error(np.array([1.0])))


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
def test_a_band_that_could_not_cover_as_often_as_it_says_is_left_out(statistic: Statistic) -> None:
    values = np.random.default_rng(0).normal(size=(FEWEST_BAND_VALUES, 400))
    assert np.isnan(band_of(values[:-1], statistic).low).all()
    band = band_of(values, statistic)
    assert np.mean((band.low <= 0.0) & (band.high >= 0.0)) > 0.85


@pytest.mark.parametrize("n", [4, 20])
def test_the_interval_covers_the_mean_of_normal_trials_as_often_as_it_says(n: int) -> None:
    repeats = 20_000  # every column is an experiment
    values = np.random.default_rng(n).normal(loc=3.0, scale=2.0, size=(n, repeats))
    band = band_of(values)
    covered = np.mean((band.low <= 3.0) & (band.high >= 3.0))
    assert covered == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / repeats))


def test_centres_by_hand() -> None:
    values = np.array([[0.0], [1.0], [2.0], [3.0], [4.0], [5.0], [6.0], [700.0]])
    assert centre(values, Statistic.MEDIAN)[0] == 3.5
    assert centre(values, Statistic.IQM)[0] == (2 + 3 + 4 + 5) / 4  # two of eight off each end
    assert centre(values, Statistic.MEAN)[0] == pytest.approx(721 / 8)


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
def test_the_bootstrap_draws_whole_trials_and_the_same_ones_each_time(statistic: Statistic) -> None:
    trials = np.random.default_rng(1).normal(size=(15, 1))
    curves = np.hstack([trials, trials, 2 * trials])  # a step repeated, and one scaled
    first, again = band_of(curves, statistic), band_of(curves, statistic)
    np.testing.assert_array_equal(first.low, again.low)
    assert first.low[0] == first.low[1]
    assert first.low[2] == pytest.approx(2 * first.low[0])
    assert (first.low <= first.centre).all()
    assert (first.centre <= first.high).all()


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
@pytest.mark.parametrize("n", [6, 7, 20, 31])
def test_the_bootstrap_equals_scipy(statistic: Statistic, n: int) -> None:
    values = np.exp(np.random.default_rng(n).normal(size=(n, 6)))
    values[:, 3] = 1.0
    values[: n // 2, 4] = 2.0  # ties
    values[0, 5] = 1e12
    iqm = partial(stats.trim_mean, proportiontocut=0.25)
    centres = {Statistic.MEDIAN: np.median, Statistic.IQM: iqm}
    found = stats.bootstrap(
        (values,),
        centres[statistic],
        n_resamples=BAND_RESAMPLES,
        batch=100,
        confidence_level=0.95,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    shown = band_of(values, statistic)
    assert shown.low == pytest.approx(found.low, rel=1e-12)
    assert shown.high == pytest.approx(found.high, rel=1e-12)


SIZES = (30, 40, 55)


def runs(seed: int, sizes: tuple[int, ...] = SIZES) -> list[npt.NDArray[np.float64]]:
    """Return runs of systems of different level and spread, two values each."""
    rng = np.random.default_rng(seed)
    return [rng.normal(place, place + 1.0, (n, 2)) for place, n in enumerate(sizes)]


def test_every_system_counts_alike() -> None:
    strata = [np.array([[0.0]] * 9 + [[1.0]]), np.array([[1.0], [3.0]])]
    assert stratified_mean(strata).centre == pytest.approx([(0.1 + 2.0) / 2])


def test_the_interval_equals_scipy() -> None:
    strata = runs(0)
    found = stratified_mean(strata)
    one = [values[:, 0] for values in strata]
    scipy = stats.bootstrap(
        one,
        lambda *parts, axis: np.mean([np.mean(part, axis=axis) for part in parts], axis=0),
        n_resamples=MEAN_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    error = (
        5 * scipy.standard_error / np.sqrt(MEAN_RESAMPLES * 0.025)
    )  # of a 2.5 % quantile, at least
    assert found.low[0] == pytest.approx(scipy.confidence_interval.low, abs=error)
    assert found.high[0] == pytest.approx(scipy.confidence_interval.high, abs=error)


def test_the_interval_of_few_runs_covers_the_mean() -> None:
    """A bootstrap of five runs of each of four systems covers 88 %."""
    rng = np.random.default_rng(0)
    found = stratified_mean([rng.normal(0.0, 1 + s, (5, 2000)) for s in range(4)])
    assert np.mean((found.low <= 0) & (found.high >= 0)) == pytest.approx(0.95, abs=0.02)
    one = rng.normal(size=(5, 1))
    alone, student = stratified_mean([one]), band_of(one)
    assert alone.low == pytest.approx(student.low)
    assert alone.high == pytest.approx(student.high)
    still = stratified_mean([np.ones((5, 1))] * 2)
    assert (still.low, still.high) == (1.0, 1.0)


def test_the_share_of_one_system_has_binomial_quantiles() -> None:
    n, hits = 40, 14
    values = np.repeat([1.0, 0.0], [hits, n - hits])[:, None]
    found = stratified_mean([values])
    quantiles = stats.binom.ppf([0.025, 0.975], n, hits / n) / n
    assert found.low[0] == pytest.approx(quantiles[0], abs=1.01 / n)
    assert found.high[0] == pytest.approx(quantiles[1], abs=1.01 / n)


def test_the_same_runs_give_the_same_interval_and_one_run_gives_none() -> None:
    np.testing.assert_array_equal(stratified_mean(runs(3)).low, stratified_mean(runs(3)).low)
    alone = stratified_mean([np.ones((5, 1)), np.array([[2.0]])])
    assert alone.centre == pytest.approx([1.5])
    assert np.isnan([alone.low, alone.high]).all()


INF = math.inf
SEEDS = range(5)


def curve(env: str, policy: str, seed: int) -> np.ndarray:
    return fake_result(make_spec(env, policy, seed, env={"horizon": 60})).loss


def test_geometric_mean_by_hand() -> None:
    values = np.array([[1.0, 4.0, 16.0], [3.0, 3.0, 3.0]])
    np.testing.assert_allclose(mean_over_steps(values), [4.0, 3.0])
    assert mean_over_steps(np.array([[0.0, 1.0]])).tolist() == [0.0]


def test_first_and_last_passage_by_hand() -> None:
    """The last is the first step of the last stretch below, so that a dip does not count."""
    curves = np.array([[5.0, 2, 3, 1], [5.0, 4, 4, 4], [1.0, 9, 9, 9], [5.0, 4, 3, 2]])
    assert first_passage(curves, 2.0).tolist() == [2, INF, 1, 4]
    curves = np.array([[5.0, 2, 3, 1], [5.0, 1, 4, 4], [1.0, 2, 1, 2], [5.0, 4, 3, 2]])
    assert last_passage(curves, 2.0).tolist() == [4, INF, 1, 4]
    assert last_passage(np.array([[1.0, math.nan], [math.nan, 1.0]]), 2.0).tolist() == [INF, 2]


def test_race_by_hand() -> None:
    found = compare_hitting_times(np.array([3.0, 5, INF, INF, 7]), np.array([4.0, 5, 8, INF, INF]))
    assert (found.n_pairs, found.reached, found.reached_reference) == (5, 3, 3)
    assert found.improvement == (2 + 2 / 2) / 5  # earlier twice, tied twice
    assert found.p_value == pytest.approx(1.0)  # two wins and one loss of three
    assert (found.median, found.median_reference) == (7, 8)
    none = compare_hitting_times(np.empty(0), np.empty(0))
    assert none.n_pairs == 0
    assert np.isnan([none.improvement, none.p_value]).all()


def test_swapping_the_sides_swaps_the_race() -> None:
    steps = np.random.default_rng(1).integers(1, 9, size=(2, 40)).astype(float)
    steps[steps > 7] = INF
    forth, back = compare_hitting_times(*steps), compare_hitting_times(*steps[::-1])
    assert forth.improvement + back.improvement == pytest.approx(1)
    assert forth.p_value == pytest.approx(back.p_value)
    assert forth.median == back.median_reference


def test_sign_test_of_a_textbook_case() -> None:
    assert sign_test(9, 1) == pytest.approx(2 * (1 + 10) / 2**10)
    assert sign_test(0, 0) == 1.0


def test_a_median_past_the_horizon_is_censored() -> None:
    assert censored_median(np.array([1.0, INF, INF])) == INF
    assert censored_median(np.array([1.0, 2.0, INF])) == 2
    assert censored_median(np.array([1.0, 2.0, INF, INF])) == INF  # just half of them reached it
    assert math.isnan(censored_median(np.empty(0)))


def test_the_area_compares_whole_curves(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("d_optimal", "random")))
    row = compare_policies(reader, selection, measure=Measure.AUC).iloc[0]
    logs = [
        np.mean(np.log(curve("pendulum", "random", s)) - np.log(curve("pendulum", "d_optimal", s)))
        for s in SEEDS
    ]
    assert row.ratio == pytest.approx(math.exp(np.mean(logs)))


def test_steps_to_what_random_inputs_know_at_the_end(reader: Reader) -> None:
    table = compare_steps(reader, select(reader, Filter()))
    row = table[(table.env == "pendulum") & (table.policy == "uniform")].iloc[0]
    finals = [curve("pendulum", "random", seed)[-1] for seed in SEEDS]
    assert row.epsilon == pytest.approx(np.median(finals))
    ours = np.array([curve("pendulum", "d_optimal", seed) for seed in SEEDS])
    assert row["median_reference"] == np.median(first_passage(ours, row.epsilon))
    assert row.reached_reference == np.sum(ours.min(axis=1) <= row.epsilon)


def test_an_epsilon_that_nobody_reaches_is_a_tie(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("d_optimal", "periodic")))
    table = compare_steps(reader, selection, epsilon=1e-9)
    assert (table.improvement.item(), table.p_value.item()) == (0.5, 1.0)
    assert "> 60" in hitting_times_table(table).markdown()


@pytest.mark.parametrize("epsilon", ["0", "-1", "inf", "nan"])
@pytest.mark.parametrize("command", ["figures", "compare"])
def test_an_epsilon_that_is_no_loss_is_refused(
    url: str, capsys: pytest.CaptureFixture[str], command: str, epsilon: str
) -> None:
    """Also where no output of the command needs it."""
    assert main([command, "--db", url, "--epsilon", epsilon]) == 2
    assert f"--epsilon is '{epsilon}', a number above 0 is expected" in capsys.readouterr().err


def test_without_random_inputs_an_epsilon_is_needed(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("d_optimal", "periodic")))
    with pytest.raises(AnalysisError, match="--epsilon"):
        compare_steps(reader, selection)


def test_a_table_in_latex_needs_no_package(reader: Reader) -> None:
    table = hitting_times_table(compare_steps(reader, select(reader, Filter())))
    text = table.latex()
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    assert text.isascii()
    assert text.startswith("% Steps")
    assert lines[0] == r"\begin{tabular}{llllllllllll}"
    assert lines[-1] == r"\end{tabular}"
    rows = [line for line in lines if line.endswith(r"\\")]
    assert len(rows) == 1 + len(table.rows)
    assert {row.count(" & ") for row in rows} == {11}
    found = [line for line in lines if line not in rows]
    assert found == [lines[0], *[r"\hline"] * 3, r"\end{tabular}"]
    assert r"$\varepsilon$" in rows[0]


def test_every_letter_of_a_label_compiles() -> None:
    row = ["adam_replay ×30", "γ=3 & λ", "50 % of #1 {x}", "q̇₁ ~ a^b", "[2, 3] m/s²"]
    text = TextTable(["a", "b", "c", "d", "e"], [row], "rad/s²\nµs").latex()
    assert text.startswith("% rad/s2\n% ")
    assert text.isascii()
    assert r"adam\_replay $\times$30 & $\gamma$=3 \& $\lambda$ & 50 \% of \#1 \{x\} & " in text
    assert r"q1 \textasciitilde{} a\^{}b & {[}2, 3] m/s$^2$ \\" in text


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("ours", "theirs", "ratio", "low", "improvement", "p_value"),
    [
        ([1, 8], [4, 4], math.sqrt(0.25 * 2), None, 0.5, None),
        ([1, 2, 4, 8, 16], [2, 4, 8, 16, 32], 0.5, 0.5, 1.0, 2 / 2**5),  # all five signs agree
        ([1, 2, 3], [1, 2, 3], 1.0, 1.0, 0.5, 1.0),
        ([0, 0, 1, 3], [0, 1, 0, 4], math.nan, math.nan, (2 + 1 / 2) / 4, math.nan),
        ([2], [1], 2.0, math.nan, 0.0, 1.0),
        ([], [], math.nan, math.nan, math.nan, math.nan),
    ],
)
def test_pairs_are_compared_by_hand(
    ours: list[float], theirs: list[float], ratio: float, low: float | None, improvement: float,
    p_value: float | None,
) -> None:  # fmt: skip
    """A loss of zero is counted but has no ratio, and too few pairs have no interval."""
    found = compare(np.array(ours, float), np.array(theirs, float), rng())
    assert found.n_pairs == len(ours)
    assert [found.ratio, found.improvement] == pytest.approx([ratio, improvement], nan_ok=True)
    assert low is None or [found.low, found.high] == pytest.approx([low, low], nan_ok=True)
    assert p_value is None or found.p_value == pytest.approx(p_value, nan_ok=True)


def test_values_that_differ_by_rounding_have_no_spread() -> None:
    values = np.full(100, -1.0)
    values[:50] = np.nextafter(-1.0, 0.0)
    assert interval_of_mean(values, rng()) == pytest.approx((-1.0, -1.0), rel=1e-12)


def test_what_was_lost_is_the_worst_in_the_test_and_in_no_ratio() -> None:
    ours = np.array([1.0, 2.0, np.inf, 4.0, np.inf, np.nan, 1.0])
    theirs = np.array([2.0, 4.0, 1.0, 1.0, np.inf, 1.0, np.nan])
    found = compare(ours, theirs, rng())
    assert found.n_pairs == 5  # without the two with a NaN
    assert without_ratio(ours, theirs) == 4
    assert found.ratio == pytest.approx(1.0)  # 1/2 · 1/2 · 4
    assert found.improvement == (2 + 0.5) / 5
    largest = np.log([1 / 2, 1 / 2, 1e9, 4.0, 1.0])
    assert found.p_value == pytest.approx(signed_rank(largest))
    nothing = compare(np.full(8, np.inf), np.arange(1.0, 9.0), rng())
    assert math.isnan(nothing.ratio)
    assert nothing.p_value == pytest.approx(2 / 2**8)


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


def test_benjamini_hochberg_leaves_out_what_was_not_tested() -> None:
    # sorted p times m / rank, then the running minimum from the right
    found = benjamini_hochberg([0.01, 0.04, math.nan, 0.03, 0.5])
    expected = [0.04, 0.16 / 3, math.nan, 0.16 / 3, 0.5]
    assert found == pytest.approx(expected, nan_ok=True)
    assert benjamini_hochberg([]) == []


COSTS = arrays(
    float, st.tuples(st.integers(1, 12), st.integers(1, 3)), elements=st.integers(0, 5).map(float)
)  # few values, so that ties are common


@given(COSTS)
def test_a_choice_is_on_the_front_exactly_if_no_other_dominates_it(
    costs: npt.NDArray[np.float64],
) -> None:
    front = on_front(costs)
    assert front.any()
    for choice, is_on in zip(costs, front, strict=True):
        dominated = np.all(costs <= choice, axis=1) & np.any(costs < choice, axis=1)
        assert is_on == (not dominated.any())


def test_a_front_by_hand() -> None:
    costs = np.array([[1, 9], [2, 5], [2, 6], [3, 5], [4, 1], [np.nan, 0], [4, 1]])
    assert on_front(costs).tolist() == [True, True, False, False, True, False, True]
    assert not len(on_front(np.empty((0, 2))))


def test_the_interval_comes_from_the_logarithms() -> None:
    assert np.isnan(geometric_mean(np.empty(0)).value)
    found = geometric_mean(np.array([1.0, 10.0, 100.0]))
    half = 4.302652729911275 / np.sqrt(3)  # t quantile of 2 degrees of freedom
    assert found.value == pytest.approx(10.0)
    assert np.log10([found.low, found.high]) == pytest.approx([1 - half, 1 + half])
