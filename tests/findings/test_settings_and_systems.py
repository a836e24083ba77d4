"""The numbers of the findings on the paper's settings, and on all systems together."""

from __future__ import annotations

import pandas as pd
import pytest

from analysis.formatting import number, within
from analysis.report.variant_table import verdict
from tests.pages import DOCS, PAGES

FINDINGS = " ".join(PAGES["docs/findings.md"].split())

SENSITIVITY = pd.read_csv(DOCS / "sensitivity/figure8_sensitivity.csv").set_index(
    ["env", "setting", "policy"]
)
PROFILES = pd.read_csv(DOCS / "profiles/figure7_profiles.csv")
CLAIMS = pd.read_csv(DOCS / "claims/report.csv").set_index(["env", "variant"])
AGGREGATE = pd.read_csv(DOCS / "profiles/aggregate.csv").set_index("variant")
RIVALS = pd.read_csv(DOCS / "rivals/report.csv").set_index(["env", "variant"])
COMPARISONS = pd.read_csv(DOCS / "adaptive_seeds/comparisons.csv").set_index(["env", "variant"])

LAMBDA, RATE, WINDOW = "policy.regularization", "learner.learning_rate", "learner.window"
SUM = "iCEM, criterion=sum"
ALL = ["pendulum", "cartpole", "arm", "quadrotor"]


def losses(env: str, setting: str, policy: str = "d_optimal") -> dict[float, float]:
    """Return the final loss at each value of a setting."""
    chosen = SENSITIVITY.loc[[(env, setting, policy)]]
    assert set(chosen["n"]) == {20}
    return dict(zip(chosen["value"], chosen["loss"], strict=True))


def spread(env: str, setting: str) -> float:
    """Return the largest final loss of D-optimal inputs by the smallest one."""
    found = losses(env, setting).values()
    return max(found) / min(found)


def window(env: str, policy: str, *sizes: float) -> list[str]:
    return [number(losses(env, WINDOW, policy)[size]) for size in sizes]


@pytest.mark.parametrize(
    ("setting", "phrase", "env"),
    [
        (LAMBDA, "by a factor of at most {} (quadrotor)", "quadrotor"),
        (RATE, "changes it by up to {} (pendulum)", "pendulum"),
    ],
)
def test_the_largest_spread_is_that_of_the_page(setting: str, phrase: str, env: str) -> None:
    spreads = {one: spread(one, setting) for one in ALL}
    assert max(spreads, key=lambda one: spreads[one]) == env
    assert phrase.format(number(spreads[env])) in FINDINGS


def test_the_learning_rates_of_the_quadrotor_are_those_of_the_table() -> None:
    own, random = losses("quadrotor", RATE), losses("quadrotor", RATE, "random")
    higher = f"quadrotor ({number(own[0.03])} against {number(own[0.01])})"
    lower = f"above random ones there ({number(own[0.001])} against {number(random[0.001])})"
    assert higher in FINDINGS
    assert lower in FINDINGS


def test_the_windows_are_those_of_the_table() -> None:
    values = [
        text
        for policy in ("d_optimal", "random")
        for env in ("cartpole", "quadrotor")
        for text in window(env, policy, 100, 400)
    ]
    phrase = (
        "their loss falls from {} to {} on the cartpole and from {} to {} on the quadrotor, that "
        "of random inputs from {} to {} and from {} to {}."
    )
    assert phrase.format(*values) in FINDINGS
    small = [*window("cartpole", "d_optimal", 25), *window("cartpole", "random", 25)]
    assert "above random ones on the cartpole ({} against {})".format(*small) in FINDINGS


@pytest.mark.parametrize("variant", ["uniform", "periodic", "random"])
def test_the_ratios_over_all_systems_are_those_of_the_aggregate(variant: str) -> None:
    row = AGGREGATE.loc[variant]
    systems = "without the quadrotor" if variant == "periodic" else "all four"
    assert f"| {variant} | {within(row.ratio, row.low, row.high)} | {systems} |" in FINDINGS


def test_the_shares_of_runs_are_those_of_the_profiles() -> None:
    shares = [
        100 * float(one.loc[one["factor"] <= 2, "share"].iloc[-1])
        for _, one in PROFILES.groupby("label")
    ]
    assert list(PROFILES.groupby("label").groups) == ["D-optimal", "periodic", "random", "uniform"]
    phrase = (
        "{:.0f} % of the runs with D-optimal inputs end within twice their geometric mean, of "
        "those with periodic inputs {:.0f} %, with random inputs {:.0f} % and with uniform "
        "inputs {:.0f} %"
    )
    assert phrase.format(*shares) in FINDINGS


def test_the_joint_criterion_of_the_look_ahead_is_compared_at_the_same_horizon() -> None:
    rows = [
        COMPARISONS.loc[("pendulum", f"look-ahead,{criterion} lookahead=20")]
        for criterion in (" criterion=joint,", "")
    ]
    intervals = [within(row.loss_ratio, row.loss_low, row.loss_high) for row in rows]
    assert "({} against {}, `adam_window`".format(*intervals) in FINDINGS


def test_the_steps_of_the_filter_are_those_of_the_claims() -> None:
    steps = [
        f"{CLAIMS.loc[(env, variant)].steps:.0f}"
        for variant in ("D-optimal, ekf", "D-optimal")
        for env in ALL
    ]
    phrase = (
        "it needs {}, {}, {} and {} steps on pendulum, cartpole, arm and quadrotor to stay below "
        "the final loss of random inputs, against {}, {}, {} and {}."
    )
    assert phrase.format(*steps) in FINDINGS


@pytest.mark.parametrize(
    ("agent", "variant"),
    [
        ("D-optimal", "D-optimal"),
        ("look-ahead", "look-ahead"),
        ("episodic agent of FLEX", "episodic plans"),
        ("receding horizon curiosity", "episodic plans, replan_every=10"),
        ("OPAX", SUM),
    ],
)
def test_the_ratios_of_the_rivals_are_those_of_the_report(agent: str, variant: str) -> None:
    rows = [RIVALS.loc[(env, variant)] for env in ALL]
    assert {row.n for row in rows} == {20}
    cells = [within(row.loss_ratio, row.loss_low, row.loss_high) for row in rows]
    assert f"| {agent} | {' | '.join(cells)} |" in FINDINGS


def test_what_the_page_says_of_the_rivals_is_told_apart() -> None:
    apart = {
        variant: {env: one for env in ALL if (one := verdict(RIVALS.loc[(env, variant)])) != "open"}
        for variant in ("D-optimal", "episodic plans", "episodic plans, replan_every=10", SUM)
    }
    assert apart == {
        "D-optimal": dict.fromkeys(ALL, "worse"),
        "episodic plans": {"cartpole": "worse"},
        "episodic plans, replan_every=10": {"quadrotor": "better"},
        SUM: dict.fromkeys(("pendulum", "cartpole", "quadrotor"), "worse"),
    }


def test_the_losses_of_the_rivals_reference_are_those_of_the_report() -> None:
    losses = [number(RIVALS.loc[(env, "iCEM"), "loss"]) for env in ALL]
    assert "{} (pendulum), {} (cartpole), {} (arm) and {} (quadrotor)".format(*losses) in FINDINGS
