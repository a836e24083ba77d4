"""The numbers on the pages are those of the tables in the repository, each rounded once."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest

from analysis.stats.intervals import band
from tests.pages import DOCS, PAGES

FINDINGS, METHOD, README = (
    " ".join(PAGES[page].split()) for page in ("docs/findings.md", "docs/method.md", "README.md")
)

CLAIMS = pd.read_csv(DOCS / "claims/report.csv").set_index(["env", "variant"])
BEYOND = pd.read_csv(DOCS / "beyond/report.csv").set_index(["env", "variant"])
CONTROL = pd.read_csv(DOCS / "claims/report_control.csv").set_index(["variant", "t"])
BEST = pd.read_csv(DOCS / "best.csv")
PERIODIC = pd.read_csv(DOCS / "periodic.csv").set_index(["policy", "env"])
SUMMARY = pd.read_csv(DOCS / "summary.csv").set_index(["env", "policy"])

RATIO = ("loss_ratio",)
INTERVAL = ("loss_ratio", "loss_low", "loss_high")
ALL = ("pendulum", "cartpole", "arm", "quadrotor")


def numbers(table: pd.DataFrame, *cells: tuple[str, str], columns: tuple[str, ...]) -> list[float]:
    """Return the columns of some rows, row by row."""
    return [float(table.loc[cell, column]) for cell in cells for column in columns]


def claims(*cells: tuple[str, str], columns: tuple[str, ...] = RATIO) -> list[float]:
    """Return columns of the report with 100 seeds."""
    return numbers(CLAIMS, *cells, columns=columns)


def beyond(*cells: tuple[str, str], columns: tuple[str, ...] = RATIO) -> list[float]:
    """Return columns of the report with 20 seeds."""
    return numbers(BEYOND, *cells, columns=columns)


def each(variant: str, *envs: str) -> list[tuple[str, str]]:
    return [(env, variant) for env in envs]


def horizons(env: str, *steps: int | None) -> list[tuple[str, str]]:
    """Return the look-ahead with these horizons; None is the default one."""
    names = ["look-ahead" + (f", lookahead={n}" if n else "") for n in steps]
    return [(env, name) for name in names]


def budgets(*limits: int | None) -> list[tuple[str, str]]:
    names = ["look-ahead" + (f", budget_us={n}" if n else "") for n in limits]
    return [("quadrotor", name) for name in names]


PHRASES = [
    (
        "Its ratio is {:.2f} on the quadrotor, {:.2f} on the pendulum and {:.2f} on the arm. It is "
        "worse than D-optimal inputs on the cartpole ({:.2f}), and on the pendulum",
        claims(*each("look-ahead", "quadrotor", "pendulum", "arm", "cartpole")),
    ),
    (
        "each step, its ratio on the quadrotor is {:.2f}.",
        claims(("quadrotor", "look-ahead, budget_us=1000")),
    ),
    ("from its linearisation: {:.2f} on the arm,", claims(("arm", "exact gain"))),
    (
        "A Gaussian process has the ratio {:.2f} on the pendulum and {:.2f} on the quadrotor, but "
        "{:.2f} on the arm. The network with Adam on samples of the whole past has {:.2f} on the "
        "cartpole and {:.2f} on the quadrotor.",
        beyond(*each("gaussian process", "pendulum", "quadrotor", "arm"))
        + beyond(*each("d optimal, adam replay", "cartpole", "quadrotor")),
    ),
    (
        "on the pendulum is {:.1f} times that of Adam",
        claims(("pendulum", "D-optimal, ekf")),
    ),
    ("held random inputs are better than D-optimal ones ({:.2f});", claims(("arm", "held random"))),
    ("better than D-optimal ones ({:.3f}, 100 seeds)", claims(("arm", "held random"))),
    (
        "quadrotor {:.3f} [{:.3f}, {:.2f}] n.s.; arm {:.3f} [{:.3f}, {:.3f}]; {:.2f} n.s. in the",
        claims(*each("exact gain", "quadrotor", "arm"), columns=INTERVAL)
        + claims(("pendulum", "exact gain")),
    ),
    (
        "ratio 0.25 | {:.3f} [{:.3f}, {:.3f}] |",
        claims(("quadrotor", "look-ahead"), columns=INTERVAL),
    ),
    (
        "(20 steps, `joint`) | {:.2f} [{:.2f}, {:.2f}] |",
        claims(("pendulum", "look-ahead, criterion=joint, lookahead=20"), columns=INTERVAL),
    ),
    (
        "(49 steps, `sum`) | {:.3f} [{:.3f}, {:.3f}] |",
        claims(("pendulum", "look-ahead"), columns=INTERVAL),
    ),
    (
        "arm {:.3f} [{:.3f}, {:.3f}]; cartpole {:.2f} [{:.2f}, {:.2f}] |",
        claims(*each("look-ahead", "arm", "cartpole"), columns=INTERVAL),
    ),
    (
        "pendulum {:.2f}, cartpole {:.2f}, arm {:.3f}, quadrotor {:.2f} n.s. |",
        claims(*each("D-optimal, ekf", *ALL)),
    ),
    (
        "has the ratios {:.2f} (pendulum), {:.2f} (cartpole), {:.2f} (arm) and {:.2f} (quadrotor).",
        claims(*each("D-optimal, adam", *ALL)),
    ),
    (
        "| ratio | {:.2f} | {:.2f} | {:.2f} | {:.3f} | {:.3f} | {:.3f} | {:.3f} |",
        claims(*horizons("pendulum", 10, 20, 30, 40, None, 65, 98)),
    ),
    (
        "5, 10 and 20 steps give the ratios {:.3f}, {:.3f} and {:.3f}.",
        claims(*horizons("quadrotor", 5, None, 20)),
    ),
    (
        "| ratio | {:.3f} | {:.3f} | {:.3f} | {:.2f} |",
        claims(*budgets(None, 1000, 500, 250)),
    ),
    (
        "whole planning [µs] | {:,.0f} | {:,.0f} | {:.0f} | {:.0f} |",
        [float(f"{us:.3g}") for us in claims(*budgets(None, 1000, 500, 250), columns=("plan_us",))],
    ),
    (
        "random features, D-optimal | {:.2f} | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("d optimal, rff", *ALL)),
    ),
    (
        "random features, held random | {:.2f} n.s. | {:.2f} n.s. | {:.2f} | {:.2f} n.s. |",
        beyond(*each("random held, rff", *ALL)),
    ),
    (
        "Gaussian process, entropy | {:.2f} | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("gaussian process", *ALL)),
    ),
    (
        "Gaussian process, held random | {:.2f} n.s. | {:.2f} | {:.2f} n.s. | {:.2f} |",
        beyond(*each("random held, gaussian process", *ALL)),
    ),
    (
        "Adam on all samples, D-optimal | {:.2f} | {:.2f} | {:.2f} n.s. | {:.2f} |",
        beyond(*each("d optimal, adam replay", *ALL)),
    ),
    (
        "Kalman filter, D-optimal | {:.1f} | {:.1f} | {:.2f} | {:.1f} n.s. |",
        beyond(*each("d optimal, ekf", *ALL)),
    ),
    (
        "disagreement of five (MAX) | {:.2f} n.s. | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("max", *ALL)),
    ),
    ("by a factor of {:.1f}, compared", beyond(("pendulum", "random held"))),
    (
        "all samples, [{:.2f}, {:.2f}], contains 1.",
        beyond(("pendulum", "d optimal, adam replay"), columns=("loss_low", "loss_high")),
    ),
    (
        "the Gaussian process has {:.2f} times",
        beyond(("arm", "gaussian process"), columns=("reachable_loss_ratio",)),
    ),
    (
        "its ratio is {:.2f} on the grid and {:.2f} on the reachable set (with 100 seeds {:.2f} "
        "and {:.2f}).",
        beyond(("arm", "random"), columns=("loss_ratio", "reachable_loss_ratio"))
        + claims(("arm", "random"), columns=("loss_ratio", "reachable_loss_ratio")),
    ),
    (
        "the trace ({:.2f}), A-optimal inputs ({:.2f}) and the ascent ({:.2f}) are slightly",
        beyond(("arm", "trace"), ("arm", "a optimal"), ("arm", "gradient")),
    ),
    (
        "worse on the pendulum ({:.1f}, {:.1f}, {:.1f}) and on the cartpole ({:.1f}, {:.1f}, "
        "{:.1f}). On the arm E-optimal inputs are better ({:.2f}).",
        beyond(
            *((env, f"{one}") for env in ALL[:2] for one in ("a optimal", "e optimal", "task")),
            ("arm", "e optimal"),
        ),
    ),
    ("the look-ahead is better ({:.2f}).", beyond(("drifting_pendulum", "lookahead"))),
    (
        "with $f = 0.99$ it is not ({:.1f}).",
        beyond(("drifting_pendulum", "d optimal, ekf, forgetting=0.99")),
    ),
    (
        "better than white noise ({:.2f}); the exact gain reaches {:.2f}.",
        beyond(("chain", "random"), ("chain", "exact")),
    ),
    (
        "D-optimal inputs coincide ({:.3f}). Held random inputs end at {:.1f} times their loss, "
        "white inputs at {:.0f} times.",
        beyond(*(("mass_spring", one) for one in ("linear", "random held", "random"))),
    ),
]


@pytest.mark.parametrize(("phrase", "values"), PHRASES, ids=[phrase for phrase, _ in PHRASES])
def test_numbers_of_the_findings_are_rounded_once(phrase: str, values: list[float]) -> None:
    assert phrase.format(*values) in FINDINGS


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        ("look-ahead", "look-ahead"),
        ("D-optimal", "D-optimal"),
        ("periodic", "periodic"),
        ("uniform", "uniform"),
        ("held random", "held random"),
        ("white random", "random"),
    ],
)
def test_numbers_of_the_control_table_are_rounded_once(name: str, variant: str) -> None:
    cells = []
    for t in (100, 200, 500):
        row = CONTROL.loc[(variant, t)]
        star = "*" if row.success_p_adjusted < 0.05 else ""
        success = f"{row.success:.2f}".removeprefix("0")
        loss = f"{row.loss:.{3 if row.loss < 1 else 2}f}"
        cells.append(f"{success}{star}, {loss}")
    assert f"| {name} | {' | '.join(cells)} |" in FINDINGS


@pytest.mark.parametrize(
    ("name", "policy", "column"),
    [
        ("sine, grid", "periodic", "loss"),
        ("square wave, grid", "periodic_square", "loss"),
        ("sine, reachable set", "periodic", "reachable_loss"),
        ("square wave, reachable set", "periodic_square", "reachable_loss"),
    ],
)
def test_numbers_of_the_periodic_inputs_are_rounded_once(
    name: str, policy: str, column: str
) -> None:
    cells = [(policy, env) for env in ("pendulum", "cartpole", "arm")]
    columns = tuple(f"{column}_{part}" for part in ("ratio", "low", "high"))
    row = "| {} |" + " {:.2f} [{:.2f}, {:.2f}] |" * len(cells)
    assert row.format(name, *numbers(PERIODIC, *cells, columns=columns)) in FINDINGS


def test_numbers_of_the_lowest_losses_are_rounded_once() -> None:
    envs = ("pendulum", "quadrotor", "cartpole", "arm")
    rows: list[list[str]] = [[], []]
    for env in envs:
        trials = BEST[BEST["env"] == env]
        found = band(np.log(trials[["final_loss"]].to_numpy()))
        digits = 4 if found.centre < np.log(0.1) else 3
        mean, low, high = (
            f"{np.exp(value[0]):.{digits}f}" for value in (found.centre, found.low, found.high)
        )
        rows[0].append(f"{mean} [{low}, {high}]")
        rows[1].append(f"{trials['step_us'].median():,.0f}")
    assert f"| loss | {' | '.join(rows[0])} |" in FINDINGS
    assert f"| time of a step [µs] | {' | '.join(rows[1])} |" in FINDINGS
    means = [np.exp(np.log(BEST[BEST["env"] == env]["final_loss"]).mean()) for env in envs]
    phrase = "{:.4f} on the pendulum, {:.4f} on the quadrotor, {:.2f} on the cartpole and {:.2f} on"
    assert phrase.format(*means) in README


def test_numbers_of_the_filter_on_the_method_page_are_rounded_once() -> None:
    envs = ("pendulum", "cartpole", "quadrotor", "arm")
    values = claims(*each("D-optimal, ekf", *envs), columns=INTERVAL)
    row = "|" + " {:.2f} [{:.2f}, {:.2f}] |" * len(envs)
    assert row.format(*values) in METHOD


TITLES = {"D-optimal": "d_optimal"}


def cells_of_the_readme() -> list[tuple[str, str, str]]:
    """Return system, policy and text of each cell of the table of final losses."""
    head, _, *rows = re.findall(r"^\| .*\|$|^\|-.*\|$", PAGES["README.md"], re.MULTILINE)[:6]
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
    assert phrase.format(*values) in README
