"""The section of a report on control compares one task, and counts what it leaves out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.cli import main
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import Selection
from analysis.formatting import number
from analysis.report import variant_table
from analysis.report.control import section, tabulate
from analysis.report.variant_table import SIGNIFICANCE
from analysis.report.variants import variant_groups
from analysis.stats.control import measure_control, scores_at
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid

SHORT = {"env": {"horizon": 40}}
SEEDS = range(6)


def test_what_the_models_are_good_for_has_a_section(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/control.db"
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    specs += make_grid(("pendulum",), ("random",), SEEDS, **SHORT)
    fill(url, specs)
    assert main(["report", "--db", url, "--out", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out/README.md").read_text()
    section = text.split("## Control with the learned model")[1].split("\n## ")[0]
    assert "success after 20" in section
    assert "| uniform" in section
    assert "| random" not in section  # was not assessed
    table = pd.read_csv(tmp_path / "out/report.csv").set_index("variant")
    with Reader.open(url) as reader:
        costs = {
            one.config.policy: scores_at(reader, one, 20).by_seed
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
    url = f"sqlite:///{tmp_path}/tasks.db"
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **control_task(20))
    specs += make_grid(("pendulum",), ("random",), SEEDS, **SHORT, **control_task(10, 30))
    weighed = control_task(20, input_weight=7.0)
    specs += make_grid(("pendulum",), ("periodic",), SEEDS, **SHORT, **weighed)
    # more trials of one policy, but fewer of the task
    specs += make_grid(("pendulum",), ("d_optimal",), range(8), **SHORT, **control_task(5))
    fill(url, specs)
    assert main(["report", "--db", url, "--out", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out/README.md").read_text()
    rows = control_rows(text)
    assert [name for name in rows[0] if name.startswith("success")] == [
        "success after 0",
        "success after 20",
        "success after 40",
    ]
    assert {row["variant"] for row in rows} >= {"D-optimal", "uniform"}
    assert not {row["variant"] for row in rows} & {"random", "periodic"}
    notes = text.split("## Notes")[1]
    assert "control with random: assessed by another task" in notes
    assert "checkpoints = [10, 30] instead of [20]" in notes
    assert "control with periodic: assessed by another task" in notes
    assert "input_weight = 7.0 instead of" in notes
    table = pd.read_csv(tmp_path / "out/report.csv").set_index("variant")
    assert table["control_ratio"].notna().to_dict() == {
        "D-optimal": False,
        "uniform": True,
        "periodic": False,
        "random": False,
    }
    assert table.loc[["uniform", "periodic", "random"], "loss_ratio"].notna().all()


def test_cells_of_control_are_below_their_own_steps(tmp_path: Path) -> None:
    """As where every trial of a variant diverged before a number of steps."""

    def stopped(spec: TrialSpec, result: TrialResult) -> TrialResult:
        if spec.policy.name != "d_optimal":
            return result
        kept = tuple(row for row in result.assessments if row.t != 10)
        return replace(result, assessments=kept)

    url = f"sqlite:///{tmp_path}/stopped.db"
    task = control_task(10, 20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    fill(url, specs, edit=stopped)
    with Reader.open(url) as opened:
        found = variant_groups(opened, Filter())
        controlled = tabulate(opened, found)
        assert controlled is not None
        text = section(controlled)
        table = variant_table.tabulate_group(opened, found[0]).set_index("variant")
        whole = measure_control(opened, Selection((found[0].variants[1],)))[0]
    rows = {row["variant"]: row for row in control_rows(text)}
    assert rows["D-optimal"]["success after 10"] == rows["D-optimal"]["cost after 10"] == "–"
    assert rows["D-optimal"]["success after 20"].startswith("1.00")
    assert rows["uniform"]["cost after 10"].startswith(number(float(whole.cost[1])))
    # no number of the reference after the task's first steps: no ratio, rather than one of others
    assert math.isnan(table.loc["uniform", "control_ratio"])


def test_lost_episodes_are_counted_beside_every_mean(tmp_path: Path) -> None:
    crashes = {("uniform", 2, "control_cost"), ("uniform", 3, "free_run_error")}

    def crashed(spec: TrialSpec, result: TrialResult) -> TrialResult:
        rows = (
            row._replace(value=math.inf)
            if row.t > 0 and (spec.policy.name, spec.seed, row.measure) in crashes
            else row
            for row in result.assessments
        )
        return replace(result, assessments=tuple(rows))

    url = f"sqlite:///{tmp_path}/lost.db"
    task = control_task(20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    fill(url, specs, edit=crashed)
    assert main(["report", "--db", url, "--out", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out/README.md").read_text()
    rows = {row["variant"]: row for row in control_rows(text)}
    assert rows["uniform"]["cost after 20"].endswith("], 1 lost")
    assert rows["uniform"]["free run"].endswith(", 1 lost")
    assert "lost" not in rows["uniform"]["cost after 0"] + "".join(rows["D-optimal"].values())
    _, line = [line for line in text.split("## Control")[0].splitlines() if "| uniform" in line]
    assert line.split("|")[5].strip().endswith("], 1 lost")
    table = pd.read_csv(tmp_path / "out/report.csv").set_index("variant")
    assert table.loc["uniform", "control_lost"] == 1
    assert math.isfinite(table.loc["uniform", "control"])
    assert table.loc["uniform", "control_p"] == pytest.approx(2 / 2**6)


def test_the_true_model_has_a_row_of_its_own(tmp_path: Path) -> None:
    def truth(spec: TrialSpec, result: TrialResult) -> TrialResult:
        changed = {"true_model_success": float(spec.seed > 2)}
        if spec.seed == 1:
            changed["true_model_cost"] = math.inf
        rows = (
            row._replace(value=changed.get(row.measure, row.value)) for row in result.assessments
        )
        return replace(result, assessments=tuple(rows))

    url = f"sqlite:///{tmp_path}/truth.db"
    task = control_task(20)
    specs = make_grid(("pendulum",), ("d_optimal", "uniform"), SEEDS, **SHORT, **task)
    fill(url, specs, edit=truth)
    assert main(["report", "--db", url, "--out", str(tmp_path / "out")]) == 0
    row = control_rows((tmp_path / "out/README.md").read_text())[-1]
    assert row["variant"] == "true model"
    for t in (0, 20, 40):
        assert row[f"success after {t}"].startswith("0.50 [0.")
        assert row[f"cost after {t}"] == "1, 1 lost"
    assert (row["free run"], row["n"]) == ("–", "6")


def test_successes_are_tested_in_pairs(tmp_path: Path) -> None:
    """Where D-optimal inputs succeed with two of eight models and uniform ones with all."""

    def decided(spec: TrialSpec, result: TrialResult) -> TrialResult:
        success = float(spec.policy.name == "uniform" or spec.seed < 2)
        rows = (
            row._replace(value=success) if row.measure == "control_success" and row.t else row
            for row in result.assessments
        )
        return replace(result, assessments=tuple(rows))

    url = f"sqlite:///{tmp_path}/pairs.db"
    specs = make_grid(
        ("pendulum",), ("d_optimal", "uniform"), range(8), **SHORT, **control_task(20)
    )
    fill(url, specs, edit=decided)
    with Reader.open(url) as opened:
        table = tabulate(opened, variant_groups(opened, Filter()))
    assert table is not None
    rows = table.set_index(["variant", "t"])
    for t in (20, 40):
        assert rows.loc[("uniform", t), "success_p"] == pytest.approx(2 / 2**6)
        assert math.isnan(rows.loc[("D-optimal", t), "success_p"])
        assert rows.loc[("uniform", t), "success_p_adjusted"] < SIGNIFICANCE
    assert math.isnan(rows.loc[("uniform", 0), "success_p"])
    cells = {row["variant"]: row for row in control_rows(section(table))}
    assert cells["uniform"]["success after 20"].startswith("1.00* [")
    assert cells["D-optimal"]["success after 20"].startswith("0.25 [")
