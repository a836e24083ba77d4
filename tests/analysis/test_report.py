"""The report: its tables, its page, labels of variants, and the section on control."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from analysis.cli import main
from analysis.data.matching import AnalysisError, Filter
from analysis.data.selection import select
from analysis.report import control_section, write_report
from analysis.stats.scores import scores_at, values_of
from analysis.style import number
from analysis.tables.comparisons import compare_policies
from analysis.tables.variants import (
    MEASURES,
    SIGNIFICANCE,
    VariantGroup,
    adjust,
    tabulate_control_of,
    tabulate_group,
    variant_groups,
    verdict,
)
from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.synthetic import fake_result, fill, filled, make_grid, make_spec, valued

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


def reported(folder: Path, specs: list[TrialSpec], **options: Any) -> tuple[str, pd.DataFrame]:
    """Store trials and return the page and the table of their report."""
    url, out = f"sqlite:///{folder}/results.db", folder / "out"
    fill(url, specs, **options)
    assert main(["report", "--db", url, "--out", str(out)]) == 0
    return (out / "README.md").read_text(), pd.read_csv(out / "report.csv").set_index("variant")


def logs_of(policy: str, seeds: Iterable[int] = SEEDS, **sections: Any) -> np.ndarray:
    """Return the logarithms of the final losses of a policy in the pendulum."""
    specs = [make_spec("pendulum", policy, seed, **SHORT, **sections) for seed in seeds]
    return np.log([fake_result(spec).loss[-1] for spec in specs])


@pytest.fixture(scope="module")
def tables(url: str) -> pd.DataFrame:
    """Return the table of the report."""
    with Reader.open(url) as reader:
        groups = variant_groups(reader, Filter())
        return adjust([tabulate_group(reader, group) for group in groups])


@pytest.fixture
def table(tables: pd.DataFrame) -> pd.DataFrame:
    """Return its rows of the pendulum, by variant."""
    return tables[tables.env == "pendulum"].set_index("variant")


def test_every_variant_has_another_label(group: VariantGroup) -> None:
    assert group.reference.label == "D-optimal"
    assert [one.label for one in group.variants[1:]] == [
        "D-optimal, adam",
        "D-optimal, form=dual",
        "oracle",
        "uniform",
        "random",
        "random, adam",
    ]


def test_ratios_are_paired_over_the_shared_seeds(table: pd.DataFrame) -> None:
    difference = logs_of("uniform") - logs_of("d_optimal")
    row = table.loc["uniform"]
    assert row["loss_ratio"] == pytest.approx(np.exp(difference.mean()))
    assert row["loss_p"] == pytest.approx(stats.wilcoxon(difference).pvalue)
    assert row["loss_low"] < row["loss_ratio"] < row["loss_high"]
    assert row["reachable_loss_ratio"] == pytest.approx(row["loss_ratio"])
    assert row["n"] == 6
    assert 0 < row["coverage"] < 1
    assert math.isnan(table.loc["D-optimal", "loss_ratio"])


def test_every_policy_is_also_compared_under_its_own_learner(
    tables: pd.DataFrame, table: pd.DataFrame
) -> None:
    difference = logs_of("random", **ONE_SAMPLE) - logs_of("d_optimal", **ONE_SAMPLE)
    row = table.loc["random, adam"]
    assert row["same_reference"] == "D-optimal, adam"
    assert row["same_loss_ratio"] == pytest.approx(np.exp(difference.mean()))
    assert row["same_loss_p"] == pytest.approx(stats.wilcoxon(difference).pvalue)
    assert table.loc["random", "same_loss_ratio"] == table.loc["random", "loss_ratio"]
    assert table.loc[["D-optimal", "D-optimal, adam"], "same_loss_ratio"].isna().all()
    for measure, count in (("loss", 9), ("same_loss", 6)):  # no references; nor, then, oracles
        tested = tables[f"{measure}_p"].dropna()
        assert len(tested) == count
        expected = stats.false_discovery_control(tested)
        assert tables[f"{measure}_p_adjusted"].dropna().to_list() == pytest.approx(expected)
    text = write_report(table.reset_index(), [], "origin", {})
    assert "  - against D-optimal, adam, " in text


def test_steps_until_the_loss_stays_below_random_inputs_are_counted(table: pd.DataFrame) -> None:
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


def test_the_loss_to_reach_comes_from_the_usual_random_inputs(tmp_path: Path) -> None:
    near = {"learner": {"window": 50}}
    specs = make_grid(("pendulum",), ("d_optimal", "random"), SEEDS, **SHORT, **ONE_SAMPLE)
    specs += make_grid(("pendulum",), ("random",), SEEDS, **SHORT, **near)
    with filled(
        tmp_path,
        specs,
        edit=lambda s, r: r if s.learner.window == 50 else replace(r, loss=3 * r.loss),
    ) as opened:
        table = tabulate_group(opened, variant_groups(opened, Filter())[0])
    finals = [fake_result(make_spec("pendulum", "random", s, **SHORT)).loss[-1] for s in SEEDS]
    assert next(name for name in table.variant if "random" in name) == "random, adam"
    assert table.epsilon.iloc[0] == pytest.approx(np.median(finals))


def test_without_random_inputs_there_is_no_loss_to_reach(tmp_path: Path) -> None:
    with filled(
        tmp_path, make_grid(("pendulum",), ("d_optimal", "uniform"), range(3), **SHORT)
    ) as opened:
        table = adjust(
            [tabulate_group(opened, group) for group in variant_groups(opened, Filter())]
        )
    assert table[["epsilon", "steps", "reached"]].isna().all(axis=None)
    assert "ε =" not in write_report(table, [], "origin", {})


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
    columns = ("ratio", "low", "high", "p", "p_adjusted")
    names = (f"{measure}_{column}" for measure in (*MEASURES, "same_loss") for column in columns)
    unknown = dict.fromkeys(names, math.nan)
    usual = {"env": "arm", "loss": 1.0, "loss_2se": 0.1, "coverage": 0.3, "coverage_2se": 0.1}
    usual |= {"epsilon": 2.5, "horizon": 500, "steps": math.inf, "reached": 0.25, "dt": 0.02}
    usual |= {"steps_p_adjusted": 0.5, "policy": "d_optimal", "policy_label": "D-optimal"}
    usual |= {"path": "kernel", "same_reference": ""}
    usual |= {"control_lost": 0, "plan_us": 2.0, "learn_us": 30.0, "n": 20, "n_diverged": 0}
    bad = {"loss_ratio": 1.5, "loss_low": 1.2, "loss_high": 1.9, "loss_p_adjusted": 1e-3}
    rows = [{"variant": "D-optimal"}, {"variant": "look-ahead", **bad}, {"variant": "max"}]
    table = pd.DataFrame([{**usual, **unknown, **row} for row in rows])
    text = write_report(table, ["arm: one"], "origin", {"arm": "report_arm"})
    assert "- better: none\n  - worse: look-ahead (1.50)\n  - not told apart: max" in text
    assert "1.50 [1.20, 1.90]" in text
    assert "ε = 2.50" in text
    assert "> 500 (0.25)" in text
    assert "500 steps of dt = 20 ms." in text
    assert "](report_arm.png)" in text
    assert "- arm: one" in text


def test_entries_with_commas_are_separated_by_semicolons(table: pd.DataFrame) -> None:
    text = write_report(table.reset_index(), [], "origin", {})
    lines = [line for line in text.splitlines() if line.startswith("  - ")]
    entries = [entry for line in lines for entry in line.split(": ")[1].split("; ")]
    names = {entry.rpartition(" (")[0] for entry in entries if entry != "none"}
    assert names == set(table.index[1:])


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
    assert "error: 1 trial missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--allow-partial"]) == 0
    assert "PARTIAL: 1 trial missing" in (tmp_path / "out/README.md").read_text()


def test_variants_may_have_different_numbers_of_seeds(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal",), range(6), **SHORT)
    specs += make_grid(("pendulum",), ("random",), range(2, 5), **SHORT)
    text, table = reported(tmp_path, specs)
    notes = text.split("## Notes")[1]
    assert "pendulum: 3 seeds: 1 variant, 6 seeds: 1 variant; a ratio is over" in notes
    assert table["n"].to_dict() == {"D-optimal": 6, "random": 3}
    expected = np.exp(np.mean(logs_of("random", (2, 3, 4)) - logs_of("d_optimal", (2, 3, 4))))
    assert table.loc["random", "loss_ratio"] == pytest.approx(expected)


def test_a_report_of_one_variant_is_refused(tmp_path: Path) -> None:
    with (
        filled(tmp_path, make_grid(("pendulum",), ("d_optimal",), range(2), **SHORT)) as reader,
        pytest.raises(AnalysisError, match="of another variant"),
    ):
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


def test_what_the_models_are_good_for_has_a_section(tmp_path: Path) -> None:
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    specs += make_grid(("pendulum",), ("random",), SEEDS, **SHORT)
    text, table = reported(tmp_path, specs)
    section = text.split("## Control with the learned model")[1].split("\n## ")[0]
    assert "success after 20" in section
    assert "| uniform" in section
    assert "| random" not in section  # was not assessed
    with Reader.open(f"sqlite:///{tmp_path}/results.db") as reader:
        costs = {
            one.config.policy: scores_at(reader, one, 20)
            for one in variant_groups(reader, Filter())[0].variants
            if one.config.config.get("task")
        }
    ratios = [costs["uniform"][seed] / costs["d_optimal"][seed] for seed in SEEDS]
    expected = np.exp(np.mean(np.log(ratios)))
    assert table.loc["uniform", "control_ratio"] == pytest.approx(expected)
    assert math.isnan(table.loc["random", "control_ratio"])


def control_task(*checkpoints: int, **fields: object) -> dict[str, dict[str, object]]:
    return {"task": {"name": "control", "checkpoints": list(checkpoints), **fields}}


def control_rows(text: str) -> list[dict[str, str]]:
    """Return the rows of the section on control, the two tables of a system side by side."""
    section = text.split("## Control with the learned model")[1].split("\n## ")[0]
    tables = [part for part in section.split("\n\n") if part.startswith("|")]
    rows: list[dict[str, str]] = []
    for table in tables:
        lines = [line.strip("|").split("|") for line in table.splitlines()]
        cells = [[cell.strip() for cell in line] for line in lines]
        found = [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]
        rows = [one | other for one, other in zip(rows or found, found, strict=True)]
    return rows


def test_costs_of_different_tasks_are_not_compared(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **control_task(20))
    specs += make_grid(("pendulum",), ("random",), SEEDS, **SHORT, **control_task(10, 30))
    weighed = control_task(20, input_weight=7.0)
    specs += make_grid(("pendulum",), ("periodic",), SEEDS, **SHORT, **weighed)
    # more trials of one policy, but fewer of the task
    specs += make_grid(("pendulum",), ("d_optimal",), range(8), **SHORT, **control_task(5))
    text, table = reported(tmp_path, specs)
    rows = control_rows(text)
    found = [name for name in rows[0] if name.startswith("success")]
    assert found == ["success after 0", "success after 20", "success after 40"]
    assert {row["variant"] for row in rows} >= {"D-optimal", "uniform"}
    assert not {row["variant"] for row in rows} & {"random", "periodic"}
    notes = text.split("## Notes")[1]
    assert "control with random: assessed by another task" in notes
    assert "checkpoints = [10, 30] instead of [20]" in notes
    assert "control with periodic: assessed by another task" in notes
    assert "input_weight = 7.0 instead of" in notes
    found = table["control_ratio"].notna().to_dict()
    assert found == {"D-optimal": False, "uniform": True, "periodic": False, "random": False}
    assert table.loc[["uniform", "periodic", "random"], "loss_ratio"].notna().all()


def test_cells_of_control_are_below_their_own_steps(tmp_path: Path) -> None:
    """As where every trial of a variant diverged before a number of steps."""

    def stopped(spec: TrialSpec, result: TrialResult) -> TrialResult:
        if spec.policy.name != "d_optimal":
            return result
        kept = tuple(row for row in result.assessments if row.t != 10)
        return replace(result, assessments=kept)

    task = control_task(10, 20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    with filled(tmp_path, specs, edit=stopped) as opened:
        found = variant_groups(opened, Filter())
        controlled = tabulate_control_of(opened, found)
        assert controlled is not None
        text = control_section(controlled)
        table = tabulate_group(opened, found[0]).set_index("variant")
        costs = values_of(scores_at(opened, found[0].variants[1], 10))
    rows = {row["variant"]: row for row in control_rows(text)}
    assert rows["D-optimal"]["success after 10"] == rows["D-optimal"]["cost after 10"] == "–"
    assert rows["D-optimal"]["success after 20"].startswith("1.00")
    assert rows["uniform"]["cost after 10"].startswith(
        number(float(np.exp(np.mean(np.log(costs)))))
    )
    # no number of the reference after the task's first steps: no ratio, rather than one of others
    assert math.isnan(table.loc["uniform", "control_ratio"])


def test_lost_episodes_are_counted_beside_every_mean(tmp_path: Path) -> None:
    crashes = {("uniform", 2, "control_cost"), ("uniform", 3, "free_run_error")}

    crashed = valued(
        lambda spec, row: (
            math.inf
            if row.t > 0 and (spec.policy.name, spec.seed, row.measure) in crashes
            else None
        )
    )
    task = control_task(20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    text, table = reported(tmp_path, specs, edit=crashed)
    rows = {row["variant"]: row for row in control_rows(text)}
    assert rows["uniform"]["cost after 20"].endswith("], 1 lost")
    assert rows["uniform"]["free run"].endswith(", 1 lost")
    assert "lost" not in rows["uniform"]["cost after 0"] + "".join(rows["D-optimal"].values())
    _, line = [line for line in text.split("## Control")[0].splitlines() if "| uniform" in line]
    assert line.split("|")[5].strip().endswith("], 1 lost")
    assert table.loc["uniform", "control_lost"] == 1
    assert math.isfinite(table.loc["uniform", "control"])
    assert table.loc["uniform", "control_p"] == pytest.approx(2 / 2**6)


def test_the_true_model_has_a_row(tmp_path: Path) -> None:
    def truth(spec: TrialSpec, row: Assessment) -> float | None:
        if row.measure == "true_model_success":
            return float(spec.seed > 2)
        return math.inf if (spec.seed, row.measure) == (1, "true_model_cost") else None

    task = control_task(20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    row = control_rows(reported(tmp_path, specs, edit=valued(truth))[0])[-1]
    assert row["variant"] == "true model"
    for t in (0, 20, 40):
        assert row[f"success after {t}"].startswith("0.50 [0.")
        assert row[f"cost after {t}"] == "1, 1 lost"
    assert (row["free run"], row["n"]) == ("–", "6")


def test_successes_are_tested_in_pairs(tmp_path: Path) -> None:
    """Where D-optimal inputs succeed with two of eight models and uniform ones with all."""

    def decided(spec: TrialSpec, row: Assessment) -> float | None:
        success = float(spec.policy.name == "uniform" or spec.seed < 2)
        return success if row.measure == "control_success" and row.t else None

    policies = ("d_optimal", "uniform")
    specs = make_grid(("pendulum",), policies, range(8), **SHORT, **control_task(20))
    with filled(tmp_path, specs, edit=valued(decided)) as opened:
        table = tabulate_control_of(opened, variant_groups(opened, Filter()))
    assert table is not None
    rows = table.set_index(["variant", "t"])
    for t in (20, 40):
        assert rows.loc[("uniform", t), "success_p"] == pytest.approx(2 / 2**6)
        assert math.isnan(rows.loc[("D-optimal", t), "success_p"])
        assert rows.loc[("uniform", t), "success_p_adjusted"] < SIGNIFICANCE
    assert math.isnan(rows.loc[("uniform", 0), "success_p"])
    cells = {row["variant"]: row for row in control_rows(control_section(table))}
    assert cells["uniform"]["success after 20"].startswith("1.00* [")
    assert cells["D-optimal"]["success after 20"].startswith("0.25 [")
