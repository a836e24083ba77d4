"""``python -m studies.real.choice``: segments of the disk's run by choice, and at random.

A seed draws the block of 5,000 samples that is left out, 200 segments of one second of the others,
the first segment, and a random order of the rest. After each segment the model is fitted to all
taken so far, and simulates the block that was left out, after a history of 50 samples.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import dopt
from analysis import outputs
from analysis.style import within
from analysis.tables.rendering import TextTable
from dopt.fitting.choice import ORDERS, State, segments_of
from dopt.fitting.model import data_of
from dopt.fitting.problem import Simulator, predicted
from dopt.fitting.simulation import Data
from orchestrate.program import Parser, answered, integer, path, run, tell
from studies.real.__main__ import CASES, parts
from studies.real.protocol import Array, windows
from studies.real.results import DRAWS, LEVEL

STORED = Path(__file__).with_name("choice.csv")

PLANT = dataclasses.replace(CASES["disk"].plant, delay=0.025)
"""The disk with its delay of one sample: six constants, and 47 parameters with eight units."""

FIRST = 200
"""First seed: the criterion was chosen on others."""

WIDTHS = (0, 8)
POOL, MOST = 200, 30
FACTOR = 1.15
"""Error that is to be reached, by the error of a fit to the whole pool."""

AFTER = (2, 4, 10, 20, 30)
"""Numbers of segments after which errors are compared."""

HELP = "segments of the disk's run by choice, beside a random one"


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Choose, print the table, and write the errors; 0."""
    parser = Parser(prog="python -m studies.real.choice", description=HELP)
    parser.add_argument("--data", type=path("--data"), help="folder with disk_train.csv.gz")
    parser.add_argument("--seeds", type=integer("--seeds"), default=20, help="number of seeds (20)")
    orders = [by for by in ORDERS if by != "random"]
    parser.add_argument("--by", choices=orders, default="error", help="what chooses (error)")
    parser.add_argument("--out", type=path("--out"), default="real", help="folder (real/)")
    options = parser.read(sys.argv[1:] if words is None else words)
    logs = [
        dopt.Log.for_plant(part, PLANT, CASES["disk"].columns)
        for part in parts("disk", options.data).values()
    ]
    seeds = range(FIRST, FIRST + options.seeds)
    rows = pd.concat([curves(logs, s, width, options.by) for s in seeds for width in WIDTHS])
    tell(sys.stdout, table(rows).markdown() + "\n")
    outputs.write_table(rows, options.out, "choice")
    return 0


def curves(
    logs: Sequence[dopt.Log],
    seed: int,
    width: int,
    order: str = "error",
    pool: int = POOL,
    most: int = MOST,
) -> pd.DataFrame:
    """Return the errors [rad] after each number of segments, chosen and at random, and of all."""
    rng = np.random.default_rng(seed)
    left_out = int(rng.integers(len(logs)))
    others = [log for i, log in enumerate(logs) if i != left_out]
    every, _ = segments_of(PLANT, others, 1.0)
    some = [every[i] for i in rng.permutation(len(every))[:pool]]  # the first one is the seed's
    test = data_of(PLANT, [logs[left_out]], "zero")
    how = {"width": width, "window": 1.0, "seed": seed}
    whole = dopt.choose(PLANT, some, 0, taken=range(pool), **how)  # type: ignore[arg-type]  # of several types
    chosen, drawn = (
        dopt.choose(PLANT, some, most - 1, taken=[0], by=by, **how).states  # type: ignore[arg-type]  # the same
        for by in (order, "random")
    )
    return pd.DataFrame(
        {
            "seed": seed,
            "parameters": chosen[0].model.q,
            "segments": np.arange(1, most + 1),
            "chosen": [error(test, state) for state in chosen],
            "random": [error(test, state) for state in drawn],
            "all": error(test, whole.states[0]),
        }
    ).round(5)


def error(test: Data, state: State) -> float:
    """Return the root mean square error of the free run of a block [rad]."""
    rows = windows(CASES["disk"], test)
    errors = predicted(Simulator(state.model, test), state.p, rows).errors[0]
    return float(np.sqrt(np.mean(np.square(errors))))


def reached(errors: Array, least: float) -> int:
    """Return the first number of segments with at most an error, one more than all without one."""
    return int(np.argmax(np.append(errors, 0.0) <= least)) + 1


def table(found: pd.DataFrame) -> TextTable:
    """Return medians over the seeds, and of their ratios with intervals of a bootstrap."""
    lines = []
    for q, own in found.groupby("parameters"):
        seeds = [each for _, each in own.groupby("seed")]
        pairs = [
            [reached(s[by].to_numpy(), FACTOR * s["all"].iloc[0]) for by in KINDS] for s in seeds
        ]
        lines.append(_line(f"{q}", f"segments until {FACTOR:g} × the error of all", pairs))
        for n in AFTER:
            at = own[own.segments == n]
            lines.append(_line(f"{q}", f"error after {n} [rad]", at[[*KINDS]].to_numpy()))
        at = own[own.segments == 1]
        lines.append(
            [f"{q}", f"error of all {POOL} [rad]", *[f"{at['all'].median():.3g}"] * 2, "", ""]
        )
    last = found.segments.max()
    note = (
        f"Medians of {found.seed.nunique()} seeds; more than {last} segments count as {last + 1}."
    )
    head = ["parameters", "what", "chosen", "random", "ratio, median", "better, equal, worse"]
    return TextTable(head, lines, note)


KINDS = ("chosen", "random")


def _line(q: str, what: str, pairs: object) -> list[str]:
    own, other = np.asarray(pairs, float).T
    ratio, rng = own / other, np.random.default_rng(0)
    drawn = np.median(ratio[rng.integers(len(ratio), size=(DRAWS, len(ratio)))], axis=1)
    ends = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    counts = [int(np.sum(sign)) for sign in (ratio < 1, ratio == 1, ratio > 1)]
    return [
        *(q, what, f"{np.median(own):.3g}", f"{np.median(other):.3g}"),
        *(within(float(np.median(ratio)), *ends), ", ".join(map(str, counts))),
    ]


if __name__ == "__main__":
    run("studies.real.choice")
