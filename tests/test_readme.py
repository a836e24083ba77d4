"""The README: short, with an example that runs and the numbers of the paper's grid."""

from __future__ import annotations

import contextlib
import io
import re

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import number, within
from tests.pages import DOCS, PAGES, blocks
from tests.pareto_table import STEP_TIMES, best_within

README = PAGES["README.md"]
WORDS = " ".join(README.split())
SUMMARY = pd.read_csv(DOCS / "summary.csv").set_index(["env", "policy"])
LONGEST = 1000
"""Words that the README may have, as ``wc -w`` counts them."""


def test_it_is_short() -> None:
    assert len(README.split()) <= LONGEST


def test_its_example_runs() -> None:
    (example,) = blocks(README, "python")
    assert len(example.strip().splitlines()) <= 10
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(example, "README.md", "exec"), {})
    loss, states, inputs = output.getvalue().strip().split(" ", 1)[0], "(501, 2)", "(500, 1)"
    assert 0 < float(loss) < 10
    assert output.getvalue().strip().endswith(f"{states} {inputs}")


@pytest.mark.parametrize(
    "part", ["docs/figure1.png", "make figures", "make test", "@inproceedings"]
)
def test_it_has_what_a_reader_looks_for(part: str) -> None:
    assert part in README


@pytest.mark.parametrize("paper", ["NeurIPS_ML4PS_2022_37", "2304.13426"])
def test_it_cites_the_paper_and_its_successor(paper: str) -> None:
    (entries,) = blocks(README, "bibtex")
    assert paper in entries
    assert README.count(paper) >= 2  # linked in the text as well


TITLES = {"D-optimal": "d_optimal"}


def cells_of_the_readme() -> list[tuple[str, str, str]]:
    """Return system, policy and text of each cell of the table of final losses."""
    head, _, *rows = re.findall(r"^\| .*\|$|^\|-.*\|$", README, re.MULTILINE)[:6]
    policies = [cell.strip() for cell in head.strip("|").split("|")][1:]
    table = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return [
        (env, TITLES.get(policy, policy), cell.strip("*"))
        for env, *cells in table
        for policy, cell in zip(policies, cells, strict=True)
    ]


def test_losses_of_the_readme_are_rounded_once() -> None:
    cells = cells_of_the_readme()
    assert {(env, policy) for env, policy, _ in cells} == set(SUMMARY.index) | {
        ("quadrotor", "periodic")
    }
    for env, policy, cell in cells:
        if cell == "no eigenmode":
            continue
        row = SUMMARY.loc[(env, policy)]
        for text, value in zip(cell.split(" ± "), (row.loss, row.loss_2se), strict=False):
            decimals = len(text.partition(".")[2])
            assert text == f"{value:.{decimals}f}", (env, policy, value)


def test_reachable_losses_of_the_readme_are_rounded_once() -> None:
    values = [
        float(SUMMARY.loc[("arm", policy), column])
        for policy in ("d_optimal", "random")
        for column in ("reachable_loss", "reachable_loss_2se")
    ]
    phrase = "except on the arm ({:.2f} ± {:.2f}, against {:.2f} ± {:.2f} for random)"
    assert phrase.format(*values) in WORDS


def test_the_lowest_losses_of_the_findings_are_rounded_once() -> None:
    losses = pd.read_csv(DOCS / "best.csv").set_index("env")["final_loss"]
    envs = ("pendulum", "quadrotor", "cartpole", "arm")
    means = [float(np.exp(np.log(losses[env]).mean())) for env in envs]
    phrase = (
        "{:.4f} on the pendulum, {:.4f} on the quadrotor, {:.2f} on the cartpole and {:.2f} on the "
        "arm"
    )
    assert phrase.format(*means) in " ".join(PAGES["docs/findings.md"].split())


def test_the_swing_ups_of_the_readme_are_counted() -> None:
    reached = pd.read_csv(DOCS / "best_control.csv").groupby("env").sum()
    assert reached.loc["pendulum", "after_200"] == 100
    assert "After 200 steps its models swing up all pendulums" in WORDS
    phrase = f"after 500 steps {reached.loc['cartpole', 'after_500']} of 100 cartpoles."
    assert phrase in WORDS


@pytest.mark.parametrize("limit", ["0.2", "1", "5", "10"])
def test_the_table_by_time_names_what_is_best_within_it(limit: str) -> None:
    name, losses = best_within(float(limit))
    cells = [number(losses[env]) for env in ("pendulum", "cartpole", "arm", "quadrotor")]
    steps = STEP_TIMES.loc[name].groupby("env")
    mean, longest = steps["mean_us"].mean().max(), steps["longest_us"].max().max()
    times = f"| {number(1e-3 * mean)} | {number(1e-3 * longest)} |"
    assert f"{times} {name} | {' | '.join(cells)} |" in README


def test_the_margin_over_periodic_is_that_of_the_claims() -> None:
    claims = pd.read_csv(DOCS / "claims/report.csv").set_index(["env", "variant"])
    row = claims.loc[("cartpole", "periodic")]
    assert (row.n, claims.loc[("cartpole", "D-optimal")].n) == (400, 400)
    assert f"(ratio {within(row.loss_ratio, row.loss_low, row.loss_high)}, 400 seeds)" in WORDS
    steps = [claims.loc[("pendulum", variant)].steps for variant in ("D-optimal", "uniform")]
    assert "({:.0f} steps against {:.0f} until".format(*steps) in WORDS
