"""The report compares every variant that is stored, and says so where the news is bad."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from analysis.cli import main
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import select
from analysis.errors import AnalysisError
from analysis.report import page
from analysis.report.variant_table import MEASURES, adjust, tabulate_group, verdict
from analysis.report.variants import VariantGroup, variant_groups
from analysis.tables.comparisons import compare_policies
from orchestrate.store import Reader
from tests.analysis.synthetic import fake_result, fill, make_grid, make_spec

SHORT = {"env": {"horizon": 40}}
SEEDS = range(6)
KINDS = ("png", "svg", "pdf")
ONE_SAMPLE = {"learner": {"name": "adam", "window": 1}}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return two systems, four policies, and the reference with another learner and form too."""
    address = f"sqlite:///{tmp_path_factory.mktemp('report')}/results.db"
    policies = ("d_optimal", "oracle", "uniform", "random")
    specs = make_grid(("pendulum", "quadrotor"), policies, SEEDS, **SHORT)
    specs += make_grid(("pendulum",), ("d_optimal", "random"), SEEDS, **SHORT, **ONE_SAMPLE)
    dual = {"policy": {"form": "dual"}}
    specs += make_grid(("pendulum",), ("d_optimal",), SEEDS, **SHORT, **dual)
    lost = next(s for s in specs if (s.system.name, s.policy.name) == ("quadrotor", "random"))
    fill(address, specs, diverged={lost.trial_key: 20})
    return address


@pytest.fixture
def reader(url: str) -> Iterator[Reader]:
    with Reader.open(url) as opened:
        yield opened


@pytest.fixture
def pendulum(reader: Reader) -> VariantGroup:
    return variant_groups(reader, Filter(("pendulum",)))[0]


def test_every_variant_has_a_label_of_its_own(pendulum: VariantGroup) -> None:
    assert pendulum.reference.label == "D-optimal"
    assert [one.label for one in pendulum.variants[1:]] == [
        "D-optimal, adam",
        "D-optimal, form=dual",
        "oracle",
        "uniform",
        "random",
        "random, adam",
    ]


def test_ratios_are_paired_over_the_shared_seeds(reader: Reader, pendulum: VariantGroup) -> None:
    table = adjust([tabulate_group(reader, pendulum)]).set_index("variant")
    finals = {
        name: np.log([fake_result(make_spec("pendulum", name, s, **SHORT)).loss[-1] for s in SEEDS])
        for name in ("d_optimal", "uniform")
    }
    difference = finals["uniform"] - finals["d_optimal"]
    row = table.loc["uniform"]
    assert row["loss_ratio"] == pytest.approx(np.exp(difference.mean()))
    assert row["loss_p"] == pytest.approx(stats.wilcoxon(difference).pvalue)
    assert row["loss_low"] < row["loss_ratio"] < row["loss_high"]
    assert row["reachable_loss_ratio"] == pytest.approx(row["loss_ratio"])
    assert row["n"] == 6
    assert 0 < row["coverage"] < 1
    assert math.isnan(table.loc["D-optimal", "loss_ratio"])


def test_every_policy_is_also_compared_under_its_own_learner(
    reader: Reader, pendulum: VariantGroup
) -> None:
    table = adjust([tabulate_group(reader, pendulum)]).set_index("variant")
    finals = {
        name: np.log(
            [
                fake_result(make_spec("pendulum", name, s, **SHORT, **ONE_SAMPLE)).loss[-1]
                for s in SEEDS
            ]
        )
        for name in ("d_optimal", "random")
    }
    difference = finals["random"] - finals["d_optimal"]
    row = table.loc["random, adam"]
    assert row["same_reference"] == "D-optimal, adam"
    assert row["same_loss_ratio"] == pytest.approx(np.exp(difference.mean()))
    assert row["same_loss_p"] == pytest.approx(stats.wilcoxon(difference).pvalue)
    assert table.loc["random", "same_loss_ratio"] == table.loc["random", "loss_ratio"]
    assert table.loc[["D-optimal", "D-optimal, adam"], "same_loss_ratio"].isna().all()
    tested = table["same_loss_p"].dropna()
    expected = stats.false_discovery_control(tested)
    assert table["same_loss_p_adjusted"].dropna().to_list() == pytest.approx(expected)
    text = page.write(table.reset_index(), [], "origin", {})
    assert "  - against D-optimal, adam, " in text


def test_steps_until_the_loss_stays_at_that_of_random_inputs_are_counted(
    reader: Reader, pendulum: VariantGroup
) -> None:
    table = tabulate_group(reader, pendulum).set_index("variant")
    curves = {
        name: [fake_result(make_spec("pendulum", name, s, **SHORT)).loss for s in SEEDS]
        for name in ("random", "d_optimal")
    }
    epsilon = np.median([curve[-1] for curve in curves["random"]])
    steps = [
        next((t + 1 for t in range(len(curve)) if np.all(curve[t:] <= epsilon)), np.inf)
        for curve in curves["d_optimal"]
    ]
    assert table.loc["D-optimal", "epsilon"] == pytest.approx(epsilon)
    assert table.loc["D-optimal", "steps"] == sorted(steps)[len(steps) // 2]
    assert table.loc["D-optimal", "reached"] == np.mean(np.isfinite(steps))
    assert table.loc["random", "reached"] <= 0.5


def test_without_random_inputs_there_is_no_loss_to_reach(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/uniform.db"
    fill(url, make_grid(("pendulum",), ("d_optimal", "uniform"), range(3), **SHORT))
    with Reader.open(url) as opened:
        table = adjust(
            [tabulate_group(opened, group) for group in variant_groups(opened, Filter())]
        )
    assert table[["epsilon", "steps", "reached"]].isna().all(axis=None)
    assert "ε =" not in page.write(table, [], "origin", {})


def test_p_values_are_adjusted_over_the_whole_report(reader: Reader) -> None:
    table = adjust([tabulate_group(reader, group) for group in variant_groups(reader, Filter())])
    tested = table["loss_p"].dropna()
    assert len(tested) == 9  # but for the two references
    expected = stats.false_discovery_control(tested)
    assert table["loss_p_adjusted"].dropna().to_list() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ratio", "p", "measure", "said"),
    [
        (0.5, 0.01, "loss", "better"),
        (2.0, 0.01, "loss", "worse"),
        (0.5, 0.2, "loss", "open"),
        (0.5, math.nan, "loss", "open"),
        (0.9, 0.01, "loss", "open"),  # the interval holds 1
        (2.0, 0.01, "coverage", "better"),
        (0.5, 0.01, "coverage", "worse"),
    ],
)
def test_a_verdict_needs_the_adjusted_test_and_the_interval(
    ratio: float, p: float, measure: str, said: str
) -> None:
    row = {f"{measure}_ratio": ratio, f"{measure}_p_adjusted": p}
    row |= {f"{measure}_low": ratio / 1.2, f"{measure}_high": ratio * 1.2}
    assert verdict(row, measure) == said


def test_a_page_calls_what_is_worse_worse() -> None:
    unknown = dict.fromkeys(
        [
            f"{measure}_{column}"
            for measure in (*MEASURES, "same_loss")
            for column in ("ratio", "low", "high", "p", "p_adjusted")
        ],
        math.nan,
    )
    usual = {"env": "arm", "loss": 1.0, "loss_2se": 0.1, "coverage": 0.3, "coverage_2se": 0.1}
    usual |= {"epsilon": 2.5, "horizon": 500, "steps": math.inf, "reached": 0.25, "dt": 0.02}
    usual |= {"steps_p_adjusted": 0.5, "policy": "d_optimal", "policy_label": "D-optimal"}
    usual |= {"path": "kernel", "same_reference": ""}
    usual |= {"control_lost": 0, "plan_us": 2.0, "learn_us": 30.0, "n": 20, "n_diverged": 0}
    bad = {"loss_ratio": 1.5, "loss_low": 1.2, "loss_high": 1.9, "loss_p_adjusted": 1e-3}
    rows = [{"variant": "D-optimal"}, {"variant": "look-ahead", **bad}, {"variant": "max"}]
    table = pd.DataFrame([{**usual, **unknown, **row} for row in rows])
    text = page.write(table, ["arm: one"], "origin", {"arm": "report_arm"})
    assert "- better: none\n  - worse: look-ahead (1.50)\n  - not told apart: max" in text
    assert "1.50 [1.20, 1.90]" in text
    assert "ε = 2.50" in text
    assert "> 500 (0.25)" in text
    assert "500 steps of dt = 20 ms." in text
    assert "](report_arm.png)" in text
    assert "- arm: one" in text


def test_entries_with_commas_are_separated_by_semicolons(reader: Reader) -> None:
    table = adjust(
        [tabulate_group(reader, group) for group in variant_groups(reader, Filter(("pendulum",)))]
    )
    text = page.write(table, [], "origin", {})
    lines = [line for line in text.splitlines() if line.startswith("  - ")]
    entries = [entry for line in lines for entry in line.split(": ")[1].split("; ")]
    names = {entry.rpartition(" (")[0] for entry in entries if entry != "none"}
    assert names == {
        one.label for one in variant_groups(reader, Filter(("pendulum",)))[0].variants[1:]
    }


def test_the_command_writes_a_page_with_picture_and_provenance(url: str, tmp_path: Path) -> None:
    folder = tmp_path / "report"
    assert main(["report", "--db", url, "--out", str(folder)]) == 0
    names = {path.name for path in folder.iterdir()}
    pictures = {f"report_{env}.{kind}" for env in ("pendulum", "quadrotor") for kind in KINDS}
    assert {"README.md", "report.csv", "report.json", *pictures} <= names
    assert "- uniform: " in (folder / "README.md").read_text()
    text = (folder / "README.md").read_text()
    assert "| random, adam " in text
    assert "5, 1 diverged" in text
    again = (folder / "report_pendulum.png").read_bytes()
    assert main(["report", "--db", url, "--out", str(folder)]) == 0
    assert (folder / "report_pendulum.png").read_bytes() == again
    assert (folder / "README.md").read_text() == text


def test_missing_trials_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = f"sqlite:///{tmp_path}/partial.db"
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(3), **SHORT)
    fill(url, specs, skipped=specs[-1:])
    words = ["report", "--db", url, "--out", str(tmp_path / "out")]
    assert main(words) == 3
    assert "1 trials are missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--allow-partial"]) == 0
    assert "PARTIAL: 1 trials are missing" in (tmp_path / "out/README.md").read_text()


def test_variants_may_have_different_numbers_of_seeds(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/unequal.db"
    specs = make_grid(("pendulum",), ("d_optimal",), range(6), **SHORT)
    fill(url, specs + make_grid(("pendulum",), ("random",), range(2, 5), **SHORT))
    assert main(["report", "--db", url, "--out", str(tmp_path / "out")]) == 0
    notes = (tmp_path / "out/README.md").read_text().split("## Notes")[1]
    assert "pendulum: 3 seeds: 1 variant, 6 seeds: 1 variant; a ratio is over" in notes
    table = pd.read_csv(tmp_path / "out/report.csv").set_index("variant")
    assert table["n"].to_dict() == {"D-optimal": 6, "random": 3}
    finals = [
        [
            np.log(fake_result(make_spec("pendulum", name, seed, **SHORT)).loss[-1])
            for seed in (2, 3, 4)
        ]
        for name in ("random", "d_optimal")
    ]
    expected = np.exp(np.mean(np.subtract(*finals)))
    assert table.loc["random", "loss_ratio"] == pytest.approx(expected)


def test_a_report_of_one_variant_is_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/one.db"
    fill(url, make_grid(("pendulum",), ("d_optimal",), range(2), **SHORT))
    with Reader.open(url) as reader, pytest.raises(AnalysisError, match="of another variant"):
        variant_groups(reader, Filter())


def test_the_tables_and_a_report_agree_to_the_last_digit(reader: Reader) -> None:
    wanted = Filter(("pendulum",), ("d_optimal", "uniform", "random"), {"learner.window": 100})
    table = compare_policies(reader, select(reader, wanted)).set_index("variant")
    report = tabulate_group(reader, variant_groups(reader, wanted)[0]).set_index("variant")
    for variant in ("uniform", "random"):
        for column in ("ratio", "low", "high", "improvement"):
            assert table[column][variant] == report[f"loss_{column}"][variant]


def test_another_reference_turns_the_ratio_round(reader: Reader) -> None:
    wanted = Filter(("pendulum",), ("d_optimal", "random"), {"learner.window": 100})
    usual = compare_policies(reader, select(reader, wanted)).iloc[0]
    turned = compare_policies(reader, select(reader, replace(wanted, reference="random"))).iloc[0]
    assert (usual.variant, usual.reference) == ("random", "D-optimal")
    assert (turned.variant, turned.reference) == ("D-optimal", "random")
    assert turned.ratio == pytest.approx(1 / usual.ratio)
    (group,) = variant_groups(reader, replace(wanted, reference="random"))
    assert group.reference.label == "random"
