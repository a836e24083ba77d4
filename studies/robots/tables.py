"""Tables of the study, from its stored rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from analysis.style import number
from studies.conclusions.tables import markdown
from studies.robots.designs import FAR

DOCS = Path(__file__).parents[2] / "docs"
ARMS = ("iiwa", "jaco")


def _values(part: str, quantity: str) -> pd.DataFrame:
    """Return the values of a quantity, with their arms, cases and seeds."""
    table = pd.read_csv(DOCS / "robots_online.csv")
    return table[(table.part == part) & (table.quantity == quantity)]


def robots_times() -> str:
    """Seconds until every joint's friction curve stays within 5 %: medians, and worst seeds."""
    values = _values("times", "seconds to 5 %")
    found = values.groupby(["case", "arm"]).value.agg(["median", "max"]).clip(upper=LONG)
    order = found["median"].groupby("case").mean().sort_values(kind="stable").index
    body = [
        [
            case,
            *(
                f"{_seconds(found, case, arm, 'median')} ({_seconds(found, case, arm, 'max')})"
                for arm in ARMS
            ),
        ]
        for case in map(str, order)
    ]
    return markdown(["motion", *(f"{arm}, {_seeds(values, arm)} seeds [s]" for arm in ARMS)], body)


LONG = 99.0
"""Seconds that stand for runs in which it did not happen."""


def _seconds(found: pd.DataFrame, case: str, arm: str, what: str) -> str:
    value = float(found.loc[(case, arm), what])  # type: ignore[arg-type]  # the stubs know no such index
    return number(value) if value < LONG else "> 8"


def _seeds(values: pd.DataFrame, arm: str) -> int:
    return int(values[values.arm == arm].seed.nunique())


def robots_coverage() -> str:
    """Intervals that held when the explorer stopped, their width, the time, shares of limits."""
    names = {
        "held: curve": "curve held",
        "held: Coulomb": "Coulomb held",
        "held: viscous": "viscous held",
        "width beside a fixed time's: curve": "width by a fixed time's, median",
        "seconds": "seconds to the stop, median",
        "share of limit: position": "share of the limits of position, largest",
        "share of limit: velocity": "of velocity",
        "share of limit: torque": "of torque",
    }
    body = []
    for quantity, title in names.items():
        values = _values("coverage", quantity).groupby("arm").value
        if quantity.startswith("held"):
            cells = [f"{100.0 * values.mean()[arm]:.1f} %" for arm in ARMS]
        elif quantity.startswith("share"):
            cells = [f"{100.0 * values.max()[arm]:.1f} %" for arm in ARMS]
        else:
            cells = [number(values.median()[arm]) for arm in ARMS]
        body.append([title, *cells])
    stopped = _values("coverage", "seconds")
    return markdown(["", *(f"{arm}, {_seeds(stopped, arm)} robots" for arm in ARMS)], body)


def robots_designs() -> str:
    """Designs of 20 s for all parameters: standard errors by multisines', and errors of fits."""
    table = pd.read_csv(DOCS / "robots_designs.csv")
    body = []
    for arm, rows in table.groupby("arm"):
        ratio = np.exp(np.log(rows.ratio).agg(["mean", "min", "max"]))
        body.append(
            [
                f"{arm}, {len(rows)} seeds",
                f"{rows.unknowns.iloc[0]}, {rows.null.median():.0f} null",
                f"{ratio['mean']:.2f} [{ratio['min']:.2f}, {ratio['max']:.2f}]",
                f"{rows.worst.max():.2f}",
                f"{100.0 * rows.share.median():.0f} %",
                f"{rows.achieved.median():.2f} [{rows.achieved.min():.2f}, "
                f"{rows.achieved.max():.2f}]",
                f"{(rows.achieved > FAR).sum()} ({rows.chance.sum():.1f})",
            ]
        )
    head = ["arm", "unknowns", "errors by multisines", "worst", "information"]
    return markdown([*head, "fit by expected", f"above {FAR:g} (by chance)"], body)


TABLES = (robots_times, robots_coverage, robots_designs)
