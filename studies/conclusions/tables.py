"""Tables of the study, from its stored rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.stats.curves import Estimate, geometric_mean
from analysis.style import number, share, within
from studies.conclusions.filter import PARTS
from studies.conclusions.network import FORMS
from studies.conclusions.trials import BEST, LEARNERS, PLANTS, SYSTEMS, explored

DOCS = Path(__file__).parents[2] / "docs"
ROWS, NETWORK = DOCS / "conclusions.csv", DOCS / "network.csv"
FILTER = DOCS / "filter_intervals.csv"
"""Rows of the published tables."""

KEYS = ["env", "plant", "policy", "learner"]
RIVALS = ("uniform", "periodic", "random")
INPUTS = {"d_optimal": "D-optimal"} | {one: one for one in RIVALS}
FEWEST = 20
"""Seeds that a cell of a table needs."""


def read(path: Path = ROWS) -> pd.DataFrame:
    """Return the rows, one for each trial."""
    return pd.read_csv(path).set_index([*KEYS, "seed"]).sort_index()


def losses(rows: pd.DataFrame, *cell: str, column: str = "loss") -> pd.Series[float]:
    """Return a column of one cell by seed; empty where there are too few trials."""
    given: Any = rows  # the stubs of pandas know no index of four levels
    if cell not in given.index.droplevel("seed"):
        return pd.Series(dtype=float)
    found: pd.Series[float] = given.loc[cell, column].dropna()
    return found if len(found) >= FEWEST else found.iloc[:0]


def middle(values: pd.Series[float]) -> Estimate:
    """Return the geometric mean of a column."""
    return geometric_mean(np.asarray(values, dtype=float))


def mean_text(values: pd.Series[float]) -> str:
    """Return a geometric mean with its interval."""
    if not len(values):
        return "–"
    found = middle(values)
    return within(found.value, found.low, found.high)


def ratio_text(these: pd.Series[float], others: pd.Series[float]) -> str:
    """Return the geometric mean of ratios over the seeds of both, with its interval."""
    both = pd.concat([these, others], axis=1, join="inner").to_numpy()
    return mean_text(pd.Series(both[:, 0] / both[:, 1])) if len(both) >= FEWEST else "–"


def markdown(head: list[str], body: list[list[str]]) -> str:
    shown = (line for line in body if set(line[1:]) != {"–"})  # some trials were not run yet
    lines = [f"| {' | '.join(line)} |\n" for line in (head, *shown)]
    return "".join([lines[0], f"|{'---|' * len(head)}\n", *lines[1:]])


def conclusions_rivals(rows: pd.DataFrame | None = None) -> str:
    """Loss over the loss of D-optimal inputs with the same learner and seed."""
    rows = read() if rows is None else rows
    body = []
    for policy in RIVALS:
        for learner in LEARNERS:
            cells = []
            for env in SYSTEMS:
                reference = losses(rows, env, "ideal", "d_optimal", learner)
                cells.append(ratio_text(losses(rows, env, "ideal", policy, learner), reference))
            body.append([f"{policy}, `{learner}`", *cells])
    return markdown(["inputs, learner", *SYSTEMS], body)


def conclusions_samples(rows: pd.DataFrame | None = None) -> str:
    """Loss with the paper's learner, and the loss that the evidence model reads out of the same."""
    rows = read() if rows is None else rows
    body = []
    for policy, title in INPUTS.items():
        cells = []
        for env in SYSTEMS:
            cell = env, "ideal", policy, "adam_window"
            pair = losses(rows, *cell), losses(rows, *cell, column="sample_loss")
            means = [number(middle(one).value) for one in pair if len(one)]
            cells.append(" / ".join(means) or "–")
        body.append([title, *cells])
    return markdown(["inputs", *SYSTEMS], body)


def conclusions_best(rows: pd.DataFrame | None = None) -> str:
    """Lowest losses with the evidence model, many steps ahead and one."""
    rows = read() if rows is None else rows
    near, far = (
        [losses(rows, env, "ideal", policy, "evidence") for env in BEST]
        for policy in ("d_optimal", "best")
    )
    body = [
        ["loss", *map(mean_text, far)],
        ["worst seed", *(number(one.max()) for one in far)],
        ["one step ahead", *map(mean_text, near)],
    ]
    return markdown(["", *BEST], body)


def conclusions_oracle(rows: pd.DataFrame | None = None) -> str:
    """Losses on the pendulum divided by the losses of the oracle with the same seed."""
    rows = read() if rows is None else rows
    oracle = losses(rows, "pendulum", "ideal", "oracle", "least_squares")
    body = []
    for policy, learner in (("best", "evidence"), *(("d_optimal", one) for one in LEARNERS)):
        these = losses(rows, "pendulum", "ideal", policy, learner)
        both = pd.concat([these, oracle], axis=1, join="inner").to_numpy()
        lower = f"{np.mean(both[:, 0] < both[:, 1]):.2f}" if len(both) >= FEWEST else "–"
        title = "many steps ahead" if policy == "best" else "D-optimal"
        body.append([f"{title}, `{learner}`", mean_text(these), ratio_text(these, oracle), lower])
    body.append(["oracle", mean_text(oracle), "1", "–"])
    return markdown(["inputs, learner", "loss", "over the oracle's", "seeds below it"], body)


def conclusions_states(rows: pd.DataFrame | None = None) -> str:
    """Width of the states, gaps between them in the box, and power near the eigenfrequency."""
    rows = read() if rows is None else rows
    body = []
    for policy, title in INPUTS.items():
        for learner in LEARNERS:
            cells = []
            for env in SYSTEMS:
                cell = env, "ideal", policy, learner
                three = [losses(rows, *cell, column=one) for one in ("width", "gap", "resonant")]
                cells.append(" / ".join(f"{one.mean():.2f}" for one in three if len(one)) or "–")
            body.append([f"{title}, `{learner}`", *cells])
    return markdown(["inputs, learner", *SYSTEMS], body)


def conclusions_plants(rows: pd.DataFrame | None = None) -> str:
    """Loss over the loss of D-optimal inputs, the pendulum behind hardware and the fitted disk."""
    rows = read() if rows is None else rows
    body = []
    for learner in LEARNERS:
        cells = [
            mean_text(losses(rows, explored(one), one, "d_optimal", learner)) for one in PLANTS
        ]
        body.append([f"D-optimal, `{learner}`: loss", *cells])
        for policy in RIVALS:
            pairs = (
                (losses(rows, explored(one), one, name, learner) for name in (policy, "d_optimal"))
                for one in PLANTS
            )
            body.append([f"{policy}, `{learner}`", *(ratio_text(*pair) for pair in pairs)])
    return markdown(["inputs, learner", *PLANTS], body)


TABLES = (
    conclusions_best,
    conclusions_rivals,
    conclusions_samples,
    conclusions_oracle,
    conclusions_states,
    conclusions_plants,
)


def tables(rows: pd.DataFrame) -> str:
    """Return all tables."""
    return "\n".join(f"{made.__doc__}\n\n{made(rows)}" for made in TABLES)


def conclusions_network(path: Path = NETWORK) -> str:
    """Loss of the network, over the loss of the evidence model on the same samples."""
    rows = pd.read_csv(path)
    rows["ratio"] = rows.loss / rows.process
    body = []
    for form in FORMS:
        cells = []
        for env in SYSTEMS:
            found = rows[(rows.form == form) & (rows.env == env)]
            times = f"{found.ratio.min():.2g}, {found.ratio.max():.2g}"
            cells.append(f"{times} ({found.seconds.mean():.0f} s)" if len(found) else "–")
        body.append([form, *cells])
    losses = [rows[rows.env == env].groupby("seed").process.first() for env in SYSTEMS]
    body.append(["the process: loss", *(", ".join(map(number, one)) or "–" for one in losses)])
    return markdown(["inputs of the network", *SYSTEMS], body)


def filter_intervals(path: Path = FILTER) -> str:
    """Whether the intervals of the filter over state and parameters hold, under both inputs."""
    body = []
    groups = pd.read_csv(path).groupby(["env", "steps", "regularization"], sort=False)
    for (env, steps, prior), part in groups:
        cells = [str(env), str(steps), f"{prior:g}"]
        for when in PARTS:
            means = part[[when, f"{when}_states", f"{when}_predictions"]].mean()
            cells.append(" / ".join((f"{means.iloc[0]:.2g}", *map(share, means.iloc[1:]))))
        ended = (part[part.policy == policy].loss.dropna() for policy in ("d_optimal", "random"))
        body.append([*cells, " / ".join(number(middle(one).value) for one in ended)])
    times = ("steps 10 to 90", "101 to 110", "200 to 500")
    return markdown(["system", "steps of a fit", "λ", *times, "loss, D-optimal / random"], body)


def filter_noise(path: Path = FILTER) -> str:
    """Loss that the noise of the pendulum's angle leaves, by the variance of the prior."""
    body = []
    for policy, part in pd.read_csv(path).dropna(subset=["left"]).groupby("policy"):
        left = (mean_text(part[name]) for name in ("left_narrow", "left", "left_wide"))
        body.append([INPUTS[str(policy)], *left, mean_text(part.loss)])
    variances = (f"variance {one:.2g}" for one in (1 / 30, 1 / 3, 1 / 0.3))
    return markdown(["inputs", *variances, "loss, steps=4"], body)


OTHERS = (conclusions_network, filter_intervals, filter_noise)
"""Tables of other rows."""
