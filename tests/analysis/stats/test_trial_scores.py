from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.data.config_matching import Filter
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import select
from analysis.errors import AnalysisError
from analysis.stats.paired_tests import censored_median, compare_hitting_times, sign_test
from analysis.stats.trial_scores import (
    Measure,
    first_passage,
    geometric_mean,
    last_passage,
    mean_losses,
    steps_to,
)
from analysis.tables.comparisons import compare_policies, compare_steps
from analysis.tables.rendering import TextTable, hitting_times_table
from orchestrate.store import Reader
from tests.analysis.synthetic import fake_result, make_spec

INF = math.inf
SEEDS = range(5)


def curve(env: str, policy: str, seed: int) -> np.ndarray:
    return fake_result(make_spec(env, policy, seed, env={"horizon": 60})).loss


def test_geometric_mean_by_hand() -> None:
    values = np.array([[1.0, 4.0, 16.0], [3.0, 3.0, 3.0]])
    np.testing.assert_allclose(geometric_mean(values), [4.0, 3.0])
    assert geometric_mean(np.array([[0.0, 1.0]])).tolist() == [0.0]


def test_first_passage_by_hand() -> None:
    curves = np.array([[5.0, 2, 3, 1], [5.0, 4, 4, 4], [1.0, 9, 9, 9], [5.0, 4, 3, 2]])
    assert first_passage(curves, 2.0).tolist() == [2, INF, 1, 4]


def test_last_passage_by_hand() -> None:
    """It is the first step of the last stretch below, so that a dip does not count."""
    curves = np.array([[5.0, 2, 3, 1], [5.0, 1, 4, 4], [1.0, 2, 1, 2], [5.0, 4, 3, 2]])
    assert last_passage(curves, 2.0).tolist() == [4, INF, 1, 4]
    assert last_passage(np.array([[1.0, math.nan], [math.nan, 1.0]]), 2.0).tolist() == [INF, 2]


def test_a_scale_moves_threshold_and_curve_alike() -> None:
    curves = np.random.default_rng(0).lognormal(size=(20, 30))
    np.testing.assert_array_equal(first_passage(curves, 0.7), first_passage(10 * curves, 7.0))


def test_race_by_hand() -> None:
    found = compare_hitting_times(np.array([3.0, 5, INF, INF, 7]), np.array([4.0, 5, 8, INF, INF]))
    assert (found.n_pairs, found.reached, found.reached_reference) == (5, 3, 3)
    assert found.improvement == (2 + 2 / 2) / 5  # earlier twice, tied twice
    assert found.p_value == pytest.approx(1.0)  # two wins and one loss of three
    assert (found.median, found.median_reference) == (7, 8)


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


def test_the_sign_test_rejects_a_true_null_as_rarely_as_it_says() -> None:
    draws = np.random.default_rng(2).exponential(size=(2000, 2, 41))
    censored = np.where(draws > 1.0, INF, draws)
    rejected = np.mean([compare_hitting_times(*pair).p_value < 0.05 for pair in censored])
    assert rejected < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 2000)


def test_a_median_past_the_horizon_is_censored() -> None:
    assert censored_median(np.array([1.0, INF, INF])) == INF
    assert censored_median(np.array([1.0, 2.0, INF])) == 2
    assert censored_median(np.array([1.0, 2.0, INF, INF])) == INF  # just half of them reached it
    assert math.isnan(censored_median(np.empty(0)))


def test_race_of_no_pair_is_nan() -> None:
    found = compare_hitting_times(np.empty(0), np.empty(0))
    assert found.n_pairs == 0
    assert math.isnan(found.improvement)
    assert math.isnan(found.p_value)


def test_scores_are_those_of_the_stored_curves(reader: Reader) -> None:
    (entry,) = select(reader, Filter(("pendulum",), ("uniform",))).entries
    curves = np.array([curve("pendulum", "uniform", seed) for seed in SEEDS])
    arguments = (reader, entry, "loss", DivergenceRule.EXCLUDE)
    np.testing.assert_allclose(
        mean_losses(*arguments).values, np.exp(np.mean(np.log(curves), axis=1))
    )
    middle = float(np.median(curves))
    np.testing.assert_array_equal(
        steps_to(*arguments, middle).values, first_passage(curves, middle)
    )


def test_a_diverged_trial_is_left_out_of_the_scores_and_counted(reader: Reader) -> None:
    (entry,) = select(reader, Filter(("cartpole",), ("random",))).entries
    scores = mean_losses(reader, entry, "loss", DivergenceRule.EXCLUDE)
    assert sorted(scores.by_seed) == [0, 1, 3, 4]
    assert scores.describe() == "4/5, 1 diverged"


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
    assert "> 60" in hitting_times_table(table, "exclude").markdown()


@pytest.mark.parametrize("epsilon", [0.0, -1.0, INF, math.nan])
def test_an_epsilon_that_is_no_loss_is_refused(reader: Reader, epsilon: float) -> None:
    with pytest.raises(AnalysisError, match="a positive number is expected"):
        compare_steps(reader, select(reader, Filter()), epsilon=epsilon)


def test_without_random_inputs_an_epsilon_is_needed(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("d_optimal", "periodic")))
    with pytest.raises(AnalysisError, match="--epsilon"):
        compare_steps(reader, selection)


def test_a_table_in_latex_needs_no_package(reader: Reader) -> None:
    table = hitting_times_table(compare_steps(reader, select(reader, Filter())), "exclude")
    text = table.latex()
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    assert text.isascii()
    assert text.startswith("% Steps")
    assert lines[0] == r"\begin{tabular}{llllllllllll}"
    assert lines[-1] == r"\end{tabular}"
    rows = [line for line in lines if line.endswith(r"\\")]
    assert len(rows) == 1 + len(table.rows)
    assert {row.count(" & ") for row in rows} == {11}
    assert [line for line in lines if line not in rows] == [
        lines[0],
        *[r"\hline"] * 3,
        r"\end{tabular}",
    ]
    assert r"$\varepsilon$" in rows[0]


def test_every_letter_of_a_label_compiles() -> None:
    row = ["adam_replay ×30", "γ=3 & λ", "50 % of #1 {x}", "q̇₁ ~ a^b", "[2, 3] m/s²"]
    text = TextTable(["a", "b", "c", "d", "e"], [row], "rad/s²\nµs").latex()
    assert text.startswith("% rad/s2\n% ")
    assert text.isascii()
    assert r"adam\_replay $\times$30 & $\gamma$=3 \& $\lambda$ & 50 \% of \#1 \{x\} & " in text
    assert r"q1 \textasciitilde{} a\textasciicircum{}b & {[}2, 3] m/s$^2$ \\" in text
