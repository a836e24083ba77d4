"""Tables of the repository whose numbers stand on the pages, and columns of them."""

from __future__ import annotations

import pandas as pd

from analysis.formatting import number, within
from tests.pages import DOCS, PAGES

FINDINGS, METHOD = (
    " ".join(PAGES[page].split()) for page in ("docs/findings.md", "docs/method.md")
)

CLAIMS = pd.read_csv(DOCS / "claims/report.csv").set_index(["env", "variant"])
BEYOND = pd.read_csv(DOCS / "beyond/report.csv").set_index(["env", "variant"])
CONTROL = pd.read_csv(DOCS / "claims_control/report_control.csv").set_index(["env", "variant", "t"])

RATIO = ("loss_ratio",)
INTERVAL = ("loss_ratio", "loss_low", "loss_high")
ALL = ("pendulum", "cartpole", "arm", "quadrotor")
LEARNERS = ("adam_window", "adam_replay", "gauss_newton")


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


def under(policy: str, learner: str) -> str:
    """Return the label of a policy under a learner."""
    return policy if learner == LEARNERS[0] else f"{policy}, {learner}"


def learners(env: str, policy: str) -> list[tuple[str, str]]:
    return [(env, under(policy, learner)) for learner in LEARNERS]


def texts(*cells: tuple[str, str], column: str = "loss_ratio") -> list[str]:
    """Return a column of the claims in the digits of the pages."""
    return [number(value) for value in claims(*cells, columns=(column,))]


def same(*cells: tuple[str, str]) -> list[str]:
    """Return the ratios to D-optimal inputs with the same learner."""
    return texts(*cells, column="same_loss_ratio")


def same_interval(env: str, variant: str, measure: str = "same_loss") -> str:
    columns = tuple(f"{measure}_{part}" for part in ("ratio", "low", "high"))
    return within(*claims((env, variant), columns=columns))
