"""The numbers of space filling on the page of findings are those of its report."""

from __future__ import annotations

import pandas as pd
import pytest

from analysis.formatting import number, within
from analysis.report.variant_table import verdict
from tests.findings.report_columns import ALL, FINDINGS
from tests.pages import DOCS

REPORT = pd.read_csv(DOCS / "space_filling/report.csv").set_index(["env", "variant"])
RIVALS = pd.read_csv(DOCS / "rivals/report.csv").set_index(["env", "variant"])
VARIANTS = {
    "`idw`": "space filling",
    "`igs`": "space filling, criterion=igs",
    "`gsx`": "space filling, criterion=gsx",
    "held random": "held random",
    "random": "random",
}
CRITERIA = ("`idw`", "`igs`", "`gsx`")


@pytest.mark.parametrize("title", VARIANTS)
def test_ratios_are_those_of_the_report(title: str) -> None:
    rows = [REPORT.loc[(env, VARIANTS[title])] for env in ALL]
    assert {row.n for row in rows} == {20}
    cells = [within(row.loss_ratio, row.loss_low, row.loss_high) for row in rows]
    assert f"| {title} | {' | '.join(cells)} |" in FINDINGS


def test_what_the_page_says_is_told_apart() -> None:
    apart = {
        title: {
            env: one
            for env in ALL
            if (one := verdict(REPORT.loc[(env, VARIANTS[title])])) != "open"
        }
        for title in CRITERIA
    }
    assert apart == {
        "`idw`": {},
        "`igs`": {"pendulum": "worse", "cartpole": "better", "arm": "worse"},
        "`gsx`": {"cartpole": "worse", "arm": "worse"},
    }
    ratios = [number(REPORT.loc[(env, "space filling"), "loss_ratio"]) for env in ALL]
    assert f"(ratios {', '.join(ratios)})" in FINDINGS


def test_losses_of_the_reference_are_those_of_the_report() -> None:
    losses = [number(REPORT.loc[(env, "D-optimal"), "loss"]) for env in ALL]
    said = "inputs, whose mean losses are {} (pendulum), {} (cartpole), {} (arm) and {} (quadrotor)"
    assert said.format(*losses) in FINDINGS


def test_sampled_plans_of_many_steps_stay_ahead() -> None:
    for env in ALL:
        losses = [REPORT.loc[(env, VARIANTS[title]), "loss"] for title in CRITERIA]
        assert min(losses) > RIVALS.loc[(env, "iCEM"), "loss"]
