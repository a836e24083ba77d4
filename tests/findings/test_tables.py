"""The numbers in tables of the pages are those of the tables of the repository, rounded once."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from analysis.formatting import number, within
from analysis.stats.intervals import band
from dopt.systems import SYSTEMS
from tests.findings.report_columns import (
    ALL,
    CLAIMS,
    CONTROL,
    FINDINGS,
    INTERVAL,
    METHOD,
    claims,
    each,
    learners,
    numbers,
    same,
    under,
)
from tests.pages import DOCS
from tests.pareto_table import STEP_TIMES, best_within, gain_kept

BEST = pd.read_csv(DOCS / "best.csv")
BEST_CONTROL = pd.read_csv(DOCS / "best_control.csv")
REPLAY = pd.read_csv(DOCS / "adam_replay.csv")
PERIODIC = pd.read_csv(DOCS / "periodic.csv").set_index(["policy", "env"])

BEST_ENVS = ("pendulum", "quadrotor", "cartpole", "arm")

CHEAPER = ("adam_replay", "gauss_newton, refit_every=10")
BUDGET = {
    "D-optimal, mlp, adam_window": {
        "floor": "floor",
        "exploration_factor": "D-optimal, `adam_window`: exploration",
        "learner_factor": "D-optimal, `adam_window`: learner",
    },
    "iCEM, mlp, gauss_newton": {
        "exploration_factor": "`icem` in the box, `gauss_newton`: exploration",
        "learner_factor": "`icem` in the box, `gauss_newton`: learner",
    },
    "iCEM, ensemble, gauss_newton": {
        "floor": "floor, five networks",
        "exploration_factor": "`icem` in the box, `gauss_newton`, five networks: exploration",
        "learner_factor": "`icem` in the box, `gauss_newton`, five networks: learner",
    },
}
"""Rows of the table of error budgets: column and words, by configuration."""

MORE_STEPS = [(60, 2e-3), (100, 1e-3)]
"""Numbers and rates of steps that the page compares with the default ones."""


@pytest.mark.parametrize(
    "policy", ["uniform", "periodic", "random", "held random", "exact gain", "look-ahead"]
)
def test_ratios_under_the_three_learners_are_those_of_the_claims(policy: str) -> None:
    assert f"| {policy} | {' | '.join(ratios(env, policy) for env in ALL)} |" in FINDINGS


def ratios(env: str, policy: str) -> str:
    """Return the ratios to D-optimal inputs under the three learners, a dash where none exist."""
    cells = [cell for cell in learners(env, policy) if cell in CLAIMS.index]
    marks = ["" if CLAIMS.loc[cell].same_loss_p_adjusted < 0.05 else " n.s." for cell in cells]
    found = [f"{ratio}{mark}" for ratio, mark in zip(same(*cells), marks, strict=True)]
    return " / ".join(found) or "–"


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        ("(Algorithm 1 as printed)", "D-optimal, adam"),
        ("`adam_replay`", "D-optimal, adam_replay"),
        ("`gauss_newton`", "D-optimal, gauss_newton"),
        ("`ekf`, λ = 0.001", "D-optimal, ekf"),
        ("`ekf`, λ = 0.1", "D-optimal, ekf, λ=0.1"),
        ("`ekf`, λ = 10", "D-optimal, ekf, λ=10"),
    ],
)
def test_ratios_of_the_learners_are_those_of_the_claims(name: str, variant: str) -> None:
    cells = [within(*claims(cell, columns=INTERVAL)) for cell in each(variant, *ALL)]
    assert f"{name} | {' | '.join(cells)} |" in FINDINGS


@pytest.mark.parametrize("learner", ["adam_window", "gauss_newton"])
def test_ratios_by_horizon_are_those_of_the_claims(learner: str) -> None:
    name = under("look-ahead", learner)
    steps = (10, 20, 30, 40, None, 65, 98)
    cells = [("pendulum", name + (f", lookahead={n}" if n else "")) for n in steps]
    assert f"| `{learner}` | {' | '.join(same(*cells))} |" in FINDINGS


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
        row = CONTROL.loc[("pendulum", variant, t)]
        star = "*" if row.success_p_adjusted < 0.05 else ""
        success = f"{row.success:.2f}".removeprefix("0")
        loss = f"{row.loss:.{3 if row.loss < 1 else 2}f}"
        cells.append(f"{success}{star}, {loss}")
    assert f"| {name} | {' | '.join(cells)} |" in FINDINGS


@pytest.mark.parametrize("learner", ["adam_window", "gauss_newton"])
@pytest.mark.parametrize(
    ("name", "policy"),
    [
        ("D-optimal", "D-optimal"),
        ("look-ahead", "look-ahead"),
        ("uniform", "uniform"),
        ("periodic", "periodic"),
        ("held random", "held random"),
        ("white random", "random"),
    ],
)
def test_successes_of_every_learner_are_rounded_once(name: str, policy: str, learner: str) -> None:
    cells = []
    for env in ALL:
        keys = [(env, under(policy, learner), t) for t in (100, 200, 500)]
        known = keys[0] in CONTROL.index
        successes = [f"{CONTROL.loc[key].success:.2f}" for key in keys if known]
        cells.append(" / ".join(successes) or "–")
    assert f"| {name}, `{learner}` | {' | '.join(cells)} |" in FINDINGS


def test_the_seeds_of_the_control_are_as_many_as_the_page_says() -> None:
    numbers_of_seeds = CONTROL["n"].unstack("t")[500].drop("true model", level="variant")
    for (env, variant), n in numbers_of_seeds.items():
        many = env == "pendulum" and "gauss_newton" not in variant
        assert n == (100 if many else 20), (env, variant)


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


@pytest.mark.parametrize(
    ("words", "column"),
    [
        ("loss", "final_loss"),
        ("loss of one network", "one_network_loss"),
        ("loss, tuned for each system", "tuned_loss"),
    ],
)
def test_the_lowest_losses_are_rounded_once(words: str, column: str) -> None:
    cells = []
    for env in BEST_ENVS:
        losses = BEST.loc[BEST["env"] == env, [column]].to_numpy()
        assert len(losses) == 100
        found = band(np.log(losses))
        digits = 4 if found.centre < np.log(0.1) else 3
        mean, low, high = (
            f"{np.exp(value[0]):.{digits}f}" for value in (found.centre, found.low, found.high)
        )
        cells.append(f"{mean} [{low}, {high}]")
    assert f"| {words} | {' | '.join(cells)} |" in FINDINGS


def test_the_gains_of_tuning_are_those_of_paired_seeds() -> None:
    gains = []
    for env in ("pendulum", "cartpole", "arm", "quadrotor"):
        losses = BEST.loc[BEST["env"] == env]
        ratios = np.log(losses["tuned_loss"] / losses["final_loss"]).to_numpy()[:, None]
        found = band(ratios)
        mean, low, high = (f"{np.exp(v[0]):.2f}" for v in (found.centre, found.low, found.high))
        gains.append(f"{mean} [{low}, {high}]")
    assert f"{', '.join(gains[:3])} and {gains[3]} times as large" in " ".join(FINDINGS.split())


def test_the_tuned_settings_are_the_best_of_those_that_were_tried() -> None:
    tried = pd.read_csv(DOCS / "best_tuning.csv")
    best = tried.loc[tried.groupby("env")["final_loss"].idxmin()].set_index("env")["settings"]
    assert dict(best) == {
        "pendulum": "lookahead=100",
        "cartpole": "lookahead=100",
        "arm": "lookahead=30",
        "quadrotor": "λ=0.0001, stride=5",
    }
    counts = tried.groupby("env").size()
    assert f"among the {counts.min()} to {counts.max()} that were tried" in FINDINGS
    losses = tried.pivot(index="env", columns="settings", values="final_loss")
    worse = (losses["λ=0.0001"] / losses["experiment=best"]).drop("quadrotor")
    assert f"λ = 0.0001 is {worse.min():.1f} to {worse.max():.1f} times worse" in FINDINGS


def test_the_times_of_a_step_are_those_of_the_table_and_below_the_time_step() -> None:
    times = STEP_TIMES.loc["iCEM, domain=box, gauss_newton, ensemble"].groupby("env")
    mean, longest = times["mean_us"].mean(), times["longest_us"].max()
    time_steps = {env: 1e6 * SYSTEMS[env]().dt for env in BEST_ENVS}
    for words, values in (
        ("time of a step, mean [µs]", mean),
        ("longest step [µs]", longest),
        ("time step of the system [µs]", time_steps),
    ):
        cells = " | ".join(f"{values[env]:,.0f}" for env in BEST_ENVS)
        assert f"| {words} | {cells} |" in FINDINGS
    assert all(longest[env] < time_steps[env] for env in BEST_ENVS)


@pytest.mark.parametrize(
    ("task", "env"),
    [
        ("pendulum, swing-up", "pendulum"),
        ("cartpole, swing-up", "cartpole"),
        ("arm, set-point", "arm"),
    ],
)
def test_successes_with_the_lowest_losses_are_rounded_once(task: str, env: str) -> None:
    cells = []
    for t in (100, 200, 500):
        successes = BEST_CONTROL.loc[BEST_CONTROL["env"] == env, f"after_{t}"]
        assert len(successes) == 100
        share = successes.mean()
        test = stats.binomtest(int(successes.sum()), len(successes))
        interval = test.proportion_ci(0.95, method="wilson")
        cells.append(f"{share:.2f} [{interval.low:.2f}, {interval.high:.2f}]")
    assert f"| {task} | {' | '.join(cells)} |" in FINDINGS


def test_the_best_configurations_by_time_are_those_of_the_figure() -> None:
    names = [best_within(limit)[0] for limit in (0.2, 1.0, 5.0, 10.0)]
    phrase = "0.2 ms in all of them is {}, at most 1 ms {}, at most 5 ms {}, and at most 10 ms {}."
    assert phrase.format(*names) in " ".join(FINDINGS.split())
    kept = [gain_kept(f"D-optimal, {name}") for name in CHEAPER]
    phrase = "keeps {:.0f} % and `gauss_newton` with `learner.refit_every=10` {:.0f} % of what"
    assert phrase.format(*(100 * share for share in kept)) in FINDINGS


def test_numbers_of_the_error_budget_are_rounded_once() -> None:
    table = pd.read_csv(DOCS / "floor/error_budget.csv").set_index(["env", "label"])
    assert set(table["n"]) == {20}
    for label, columns in BUDGET.items():
        for column, words in columns.items():
            cells = [number(table.loc[(env, label), column]) for env in ALL]
            assert f"| {words} | {' | '.join(cells)} |" in FINDINGS
    learner_of_best = table.xs("iCEM, mlp, gauss_newton", level="label")["learner_factor"]
    assert learner_of_best.max() < 4 / 3
    assert (learner_of_best < 1).sum() == 3


def replay_losses() -> pd.DataFrame:
    """Return the geometric means of the final losses, one column for each system."""
    keys = ["policy", "steps", "learning_rate", "env"]
    losses = REPLAY.assign(log=np.log(REPLAY["final_loss"])).groupby(keys)["log"].mean()
    return np.exp(losses.unstack("env")[list(ALL)])


def test_numbers_of_the_settings_of_adam_replay_are_rounded_once() -> None:
    names = {"d_optimal": "D-optimal", "random_held": "held random"}
    table = replay_losses()
    assert len(table) == 8
    for (policy, steps, rate), row in table.iterrows():
        cells = [f"{value:#.3g}" for value in row]
        assert f"| {names[policy]}, {steps}, {rate:g} | {' | '.join(cells)} |" in FINDINGS


def test_more_steps_of_adam_replay_gain_what_the_page_says() -> None:
    over_systems = np.exp(np.log(replay_losses()).mean(axis=1))["d_optimal"]
    gains = [1 - over_systems[setting] / over_systems[30, 3e-3] for setting in MORE_STEPS]
    assert "by {:.0f} and {:.0f} % (rate 0.001)".format(*(100 * gain for gain in gains)) in FINDINGS


def test_numbers_of_the_filter_on_the_method_page_are_rounded_once() -> None:
    envs = ("pendulum", "cartpole", "quadrotor", "arm")
    cells = [within(*claims(cell, columns=INTERVAL)) for cell in each("D-optimal, ekf", *envs)]
    assert f"| {' | '.join(cells)} |" in METHOD
