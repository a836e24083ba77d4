"""Tables as Markdown and LaTeX, and the calibration of intervals."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import select
from analysis.errors import AnalysisError
from analysis.report import CAPTION, EXPLAINED
from analysis.stats.curves import Axis, measure_curves, tabulate_curves
from analysis.stats.scores import Measure
from analysis.style import count_text, number, p_text, plus_minus
from analysis.tables.comparisons import compare_policies, summarise
from analysis.tables.rendering import comparison_table, control_table, summary_table
from dopt.offline_fit import held_out_fit
from dopt.run import run_trial
from orchestrate.store import Reader
from tests.analysis.synthetic import fake_result, fill, make_spec, simulated
from tests.dopt.trials import trial

SEEDS = range(5)


def final(env: str, policy: str, seed: int) -> float:
    spec = make_spec(env, policy, seed, env={"horizon": 60})
    return float(fake_result(spec).loss[-1])


def test_summary_is_that_of_the_trials(reader: Reader) -> None:
    table = summarise(reader, select(reader, Filter()))
    row = table[(table.env == "pendulum") & (table.policy == "uniform")].iloc[0]
    losses = np.array([final("pendulum", "uniform", seed) for seed in SEEDS])
    assert row.loss == pytest.approx(losses.mean())
    assert row.loss_2se == pytest.approx(2 * losses.std(ddof=1) / math.sqrt(5))
    assert row.reachable_loss == pytest.approx(losses.mean() / 2)
    assert row.n == 5


def test_a_diverged_trial_is_left_out_counted_or_the_worst(reader: Reader) -> None:
    selection = select(reader, Filter(("cartpole",), ("random",)))
    losses = [final("cartpole", "random", seed) for seed in SEEDS if seed != 2]
    left_out = summarise(reader, selection).iloc[0]
    assert (left_out.n, left_out.n_diverged) == (4, 1)
    assert left_out.loss == pytest.approx(np.mean(losses))
    worst = summarise(reader, selection, DivergenceRule.WORST).iloc[0]
    assert worst.n == 5
    assert worst.loss == pytest.approx(np.mean([*losses, max(losses)]))


def test_comparison_pairs_the_seeds(reader: Reader) -> None:
    table = compare_policies(reader, select(reader, Filter()))
    row = table[(table.env == "cartpole") & (table.policy == "random")].iloc[0]
    seeds = [seed for seed in SEEDS if seed != 2]
    logs = [
        math.log(final("cartpole", "random", seed) / final("cartpole", "d_optimal", seed))
        for seed in seeds
    ]
    assert (row.n_pairs, row.n_diverged) == (4, 1)
    assert row.ratio == pytest.approx(math.exp(np.mean(logs)))
    assert row.low <= row.ratio <= row.high
    assert row.p_adjusted >= row.p_value
    assert len(table) == 4 + 4 + 3


def test_a_row_does_not_depend_on_the_others(reader: Reader) -> None:
    whole = compare_policies(reader, select(reader, Filter()))
    part = compare_policies(
        reader, select(reader, Filter(("cartpole",), ("d_optimal", "periodic")))
    )
    same = whole[(whole.env == "cartpole") & (whole.policy == "periodic")]
    columns = ["n_pairs", "ratio", "low", "high", "p_value"]
    assert same[columns].to_numpy().tolist() == part[columns].to_numpy().tolist()


def test_the_other_column(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",)))
    loss, reachable = (
        compare_policies(reader, selection, column) for column in ("loss", "reachable_loss")
    )
    assert reachable.ratio.to_numpy() == pytest.approx(loss.ratio.to_numpy())


def test_nothing_to_compare_is_a_sentence(reader: Reader) -> None:
    with pytest.raises(AnalysisError, match="only random is selected"):
        compare_policies(reader, select(reader, Filter(policies=("random",))))


def test_curves_are_means_on_the_exact_grid(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("random",)))
    arguments = (reader, selection, "loss", DivergenceRule.EXCLUDE)
    table = tabulate_curves(measure_curves(*arguments, Axis.STEPS))
    losses = [
        fake_result(make_spec("pendulum", "random", seed, env={"horizon": 60})).loss
        for seed in SEEDS
    ]
    assert table["t"].tolist() == list(range(60))
    assert table["mean"].to_numpy() == pytest.approx(np.mean(losses, axis=0))
    seconds = tabulate_curves(measure_curves(*arguments, Axis.SECONDS))
    dt = selection.entries[0].config.dt
    assert seconds["x"].to_numpy() == pytest.approx(dt * table["x"].to_numpy())


@pytest.mark.parametrize(
    ("mean", "error", "text"),
    [
        (12.345, 0.567, "12.35 ± 0.57"),
        (1234.5, 56.7, "1234 ± 57"),
        (0.01234, 0.00056, "0.01234 ± 0.00056"),
        (4.021e-5, 6.2e-6, "(4.02 ± 0.62)e-05"),
        (2.0, math.nan, "2.00"),
        (math.nan, math.nan, "–"),
    ],
)
def test_plus_minus(mean: float, error: float, text: str) -> None:
    assert plus_minus(mean, error) == text


def test_numbers() -> None:
    assert number(0.5) == "0.500"
    assert number(1234.0) == "1230"
    assert number(0.0123456) == "0.0123"
    assert number(0.9996) == "1.00"
    assert number(999.6) == "1000"
    assert number(1.5e-7) == "1.50e-07"
    assert number(0.0) == "0"
    assert p_text(0.0123) == "0.012"
    assert p_text(3.21e-9) == "3e-09"


def test_markdown_shows_counts_and_dashes() -> None:
    nothing = {"ratio": math.nan, "low": math.nan, "high": math.nan, "improvement": math.nan}
    row = {
        "env": "arm",
        "variant": "random",
        "reference": "D-optimal",
        "n_pairs": 0,
        "n_diverged": 3,
        **nothing,
    }
    table = pd.DataFrame([row | {"p_value": math.nan, "p_adjusted": math.nan}])
    assert "Student's below 30 and above 2000 pairs" in comparison_table(table, "exclude").note
    line = comparison_table(table, "exclude").markdown().splitlines()[2]
    assert [field.strip() for field in line.strip("|").split("|")] == [
        "arm", "random", "D-optimal", "–", "–", "–", "–", "0, 3 diverged",
    ]  # fmt: skip
    values = {
        f"{name}{part}": value
        for name in ("loss", "reachable_loss")
        for part, value in (("", 1.0), ("_2se", 0.1), ("_median", 0.9), ("_iqm", 0.95))
    }
    counts = {"env": "arm", "policy": "random", "label": "random", "n": 98, "n_diverged": 2}
    summary = summary_table(pd.DataFrame([counts | values]), "worst").markdown()
    assert "1.00 ± 0.10" in summary
    assert "Diverged trials: worst." in summary


def test_every_caption_says_what_is_divided_by_what() -> None:
    for note in (
        comparison_table(pd.DataFrame(), "exclude").note,
        comparison_table(pd.DataFrame(), "exclude", Measure.AUC).note,
        control_table(pd.DataFrame()).note,
    ):
        assert "atio: variant / reference, below 1 the variant is better" in note
    explained = " ".join(EXPLAINED)
    assert "Ratio: variant / reference" in explained
    assert "below 1 the variant is better" in explained
    assert "variant / reference: left of the line, below 1, the variant is better" in CAPTION


def test_count_text() -> None:
    assert count_text({"a": "5", "b": "5"}) == "n = 5"
    assert count_text({"a": "5", "b": "4/5, 1 diverged", "c": "5"}) == ("n = 5; b: 4/5, 1 diverged")


LEARNER = {"name": "gauss_newton"}


TAUGHT = [trial("pendulum", "d_optimal", seed, learner=LEARNER) for seed in range(3)]


UNSURE = [trial("pendulum", "random", seed, learner={"name": "adam_window"}) for seed in range(3)]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('calibration')}/results.db"
    fill(address, TAUGHT + UNSURE, edit=simulated)
    return address


def test_rows_are_the_medians_of_the_trials(small: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibration", "--db", small, "--format", "csv"]) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out)).set_index("policy")
    results = [run_trial(spec) for spec in TAUGHT]
    fits = [
        held_out_fit(spec, one.parameters, one.states, one.inputs)
        for spec, one in zip(TAUGHT, results, strict=True)
    ]
    row = table.loc["d_optimal"]
    for name in ("r_squared", "covered", "log_loss"):
        for kind in ("grid", "reachable"):
            average = np.mean if name == "covered" else np.median
            expected = average([getattr(getattr(fit, kind), name) for fit in fits])
            assert row[f"{kind}_{name}"] == pytest.approx(expected, rel=1e-3)
    assert row.energy == pytest.approx(1.0)  # every input is on the sphere
    assert row.n == 3
    assert np.isnan(table.loc["random", "grid_covered"])


def test_a_model_without_a_covariance_has_a_dash(
    small: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibration", "--db", small, "--policy", "random"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "pendulum" in line]
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[4:8] == ["–"] * 4
    assert "–" not in cells[2:4] + cells[8:]


def test_a_database_without_a_finished_trial_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/none.db"
    fill(address, TAUGHT, skipped=TAUGHT)
    assert main(["calibration", "--db", address, "--allow-partial"]) == 2
    assert "No selected trial is done" in capsys.readouterr().err
