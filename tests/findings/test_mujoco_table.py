"""The numbers of the Control Suite on the page of yardsticks are those of its report."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import number, within
from dopt.evaluation import evaluation_set
from dopt.systems import SIMULATORS
from tests.pages import DOCS, PAGES

PAGE = " ".join(PAGES["docs/yardsticks.md"].split())
REPORT = pd.read_csv(DOCS / "mujoco/report.csv").set_index(["env", "variant"])
ENVS = tuple(f"mujoco_{name}" for name in ("pendulum", "cartpole", "acrobot", "reacher"))


def row(title: str, cells: list[str]) -> str:
    return f"| {title} | {' | '.join(cells)} |"


@pytest.mark.parametrize("measure", ["loss", "reachable_loss"])
@pytest.mark.parametrize("policy", ["D-optimal", "held random", "look-ahead"])
def test_ratios_are_those_of_the_report(policy: str, measure: str) -> None:
    columns = [f"{measure}_{part}" for part in ("ratio", "low", "high")]
    cells = [within(*REPORT.loc[(env, policy), columns]) for env in ENVS]
    assert row(policy, cells) in PAGE


@pytest.mark.parametrize(
    ("title", "measure"),
    [("random, loss", "loss"), ("random, reachable set", "reachable_loss")],
)
def test_losses_are_those_of_the_report(title: str, measure: str) -> None:
    assert row(title, [number(REPORT.loc[(env, "random"), measure]) for env in ENVS]) in PAGE


def test_the_loss_of_no_model_is_that_of_the_grid() -> None:
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    found = [evaluation_set(SIMULATORS[env]()) for env in ENVS]
    squares = [np.sum(one.accelerations[: one.n_grid] ** 2, axis=1) for one in found]
    cells = [number(float(np.sqrt(square.mean()))) for square in squares]
    assert row("a model that predicts 0", cells) in PAGE


def test_what_the_page_says_is_told_apart() -> None:
    losses = REPORT.loss_p_adjusted < 0.05
    better, worse = losses & (REPORT.loss_high < 1), losses & (REPORT.loss_low > 1)
    assert {policy for env, policy in REPORT[better].index if env == ENVS[1]} == {"look-ahead"}
    assert not any(env == ENVS[1] for env, _ in REPORT[worse].index)
    assert (ENVS[3], "D-optimal") in REPORT[worse].index
    assert (ENVS[3], "look-ahead") not in [*REPORT[better].index, *REPORT[worse].index]
    assert REPORT.loc[(ENVS[3], "look-ahead"), "reachable_loss_low"] > 1
    pendulum = REPORT.loc[ENVS[0]]
    times = [round(1 / pendulum.loss_ratio[name]) for name in ("D-optimal", "look-ahead")]
    assert times == [73, 36]
    visited = [100 * pendulum.coverage[name] for name in ("random", "D-optimal")]
    cells = "visit {:.2g} % of the cells of the phase plane, D-optimal inputs {:.2g} %"
    assert cells.format(*visited) in PAGE
    reacher = REPORT.loc[ENVS[3]]
    visited = [100 * reacher.coverage[name] for name in ("D-optimal", "random")]
    assert "they visit {:.2g} % of the cells, random ones {:.2g} %".format(*visited) in PAGE
    assert set(REPORT.loc[list(ENVS[1:3])].n) == {20}
    assert set(REPORT.loc[[ENVS[0], ENVS[3]]].n) == {100}
