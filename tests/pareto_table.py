"""The configurations of the published figure 6, over all systems together."""

from __future__ import annotations

import numpy as np
import pandas as pd

from tests.pages import DOCS

POINTS = pd.read_csv(DOCS / "pareto/figure6_pareto.csv")
POINTS["name"] = POINTS["policy_label"] + ", " + POINTS["learner_label"]
LOSSES, TIMES = (
    POINTS.pivot_table(index="name", columns="env", values=column).dropna()
    for column in ("loss", "us_per_step")
)
STEP_TIMES = pd.read_csv(DOCS / "step_times.csv").set_index("configuration")
"""Times of the steps of some of them, by system and seed."""


def over_systems() -> pd.Series:
    """Return the geometric mean of the losses over the systems, by configuration."""
    return np.exp(np.log(LOSSES).mean(axis=1))


def best_within(limit: float) -> tuple[str, pd.Series]:
    """Return the configuration with the lowest loss whose steps take at most so many ms."""
    in_time = TIMES.max(axis=1) <= 1000 * limit
    name = str(over_systems()[in_time].idxmin())
    return name, LOSSES.loc[name]


def gain_kept(name: str) -> float:
    """Return the share of what gauss_newton gains over adam_window with D-optimal inputs [log]."""
    means = np.log(over_systems())
    window, own, full = (
        means[one] for one in ("D-optimal, adam_window", name, "D-optimal, gauss_newton")
    )
    return float((window - own) / (window - full))
