"""``python -m studies.real``: recorded runs of four real plants, beside published numbers."""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from analysis import outputs
from orchestrate.program import Parser, UsageError, answered, integer, path, run, tell
from studies.real import data, plants, results
from studies.real.protocol import Case, folds
from studies.real.results import Question, root_mean_square, typical

HELP = "recorded runs of four real plants, beside published numbers"

BLOCKS = 6
"""Parts of the one run of the disk, each left out once."""

_JOINTS = {"angle1": "pos_meas1", "angle2": "pos_meas2"}
_TORQUES = {kind: {f"torque{i}": f"tau_{kind}{i}" for i in (1, 2)} for kind in ("meas", "con")}

CASES = {
    "disk": Case(
        plants.DISK,
        {"angle": "th", "voltage": "u"},
        history=1.25,  # 50 samples
    ),
    "pendulum": Case(
        plants.PENDULUM,
        {"angle": "position", "torque": "torque"},
        history=0.2,
        reference=plants.published(plants.PENDULUM, plants.LEADERBOARD),
        horizons=(0.5, 1.0),
        moved=0.3,
        options={"hold": "linear", "width": 0},
    ),
    "double pendulum": Case(
        plants.DOUBLE_PENDULUM,
        _JOINTS | _TORQUES["meas"],
        history=0.2,
        reference=plants.MODEL_2_PLANT,
        horizons=(0.5, 1.0),
        options={"width": 0},
    ),
    "double pendulum, commanded torque": Case(
        plants.DOUBLE_PENDULUM,
        _JOINTS | _TORQUES["con"],
        history=0.2,
        reference=plants.MODEL_2_PLANT,
        horizons=(0.5, 1.0),
        options={"width": 0},
    ),
    "qube": Case(
        plants.QUBE,
        {"arm": "theta", "pendulum": "alpha", "voltage": "plant_input"},
        history=0.05,
        reference=plants.published(plants.QUBE, plants.QUANSER),
        horizons=(0.1, 0.2),
        options={"width": 0},
        controller=plants.BALANCER,
    ),
}
"""Plants that are fitted, by their names in ``--only``."""

QUESTIONS = [
    Question("disk", "free run of 5,000 samples, RMSE", root_mean_square, (0, 0), 0.0165, False),
    *(
        Question("pendulum", f"angle, {t} s, median", typical, (h, 0), 0.40)
        for h, t in enumerate((".5", "1"))
    ),
    *(
        Question(name, f"joint {c + 1}, {t} s, {kind}", measure, (h, c), bound)
        for name in ("double pendulum", "double pendulum, commanded torque")
        for kind, measure, h, t, most in (
            ("RMSE", root_mean_square, 0, ".5", 0.6),
            ("median", typical, 0, ".5", 1.5),
            ("median", typical, 1, "1", 1.1),
        )
        for c in (0, 1)
        for bound in [most if name == "double pendulum" else np.nan]
    ),
    *(
        Question("qube", f"{angle}, {t} s, RMSE", root_mean_square, (h, c), 0.45)
        for h, t in enumerate((".1", ".2"))
        for c, angle in enumerate(("arm", "pendulum"))
    ),
]
"""Rows of the table."""


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Fit, print the table, and write it; 0."""
    parser = Parser(prog="python -m studies.real", description=HELP)
    parser.add_argument("--only", action="append", choices=[*CASES], help="a plant (all of them)")
    parser.add_argument(
        "--data",
        type=path("--data"),
        default=os.environ.get("DOPT_DATA"),
        help="folder with RUN.csv.gz ($DOPT_DATA; without both, runs are downloaded)",
    )
    parser.add_argument("--out", type=path("--out"), default="real", help="folder (real/)")
    parser.add_argument("--workers", type=integer("--workers"), default=2, help="threads (2)")
    parser.add_argument(
        "--test", type=path("--test"), help="predict this run instead, with a fit to all of --only"
    )
    options = parser.read(sys.argv[1:] if words is None else words)
    if options.test is not None and len(options.only or []) != 1:
        raise UsageError(
            f"--test is {str(options.test)!r} with {len(options.only or [])} plants in --only, but "
            f"one plant is expected with it: give --only, such as --only disk."
        )
    found = _measured(options)
    tell(sys.stdout, results.table(found).markdown() + "\n")
    outputs.write_table(found, options.out, "results")
    return 0


def _measured(options: argparse.Namespace) -> pd.DataFrame:
    began = time.monotonic()
    test = None if options.test is None else data.read(options.test)
    found = {}
    for name in options.only or CASES:

        def say(text: str, name: str = name) -> None:
            tell(sys.stderr, f"{time.monotonic() - began:5.0f} s  {name}, {text}\n")

        found[name] = folds(CASES[name], parts(name, options.data), test, options.workers, say)
    return results.rows(QUESTIONS, found)


def parts(name: str, folder: Path | None) -> Mapping[str, pd.DataFrame]:
    """Return what is left out in turn: runs, or blocks of the one run of the disk."""
    runs = data.tables(name.split(",")[0], folder)
    if name != "disk":
        return runs
    (only,) = runs.values()
    cuts = np.linspace(0, len(only), BLOCKS + 1).astype(int)
    return {
        f"block {i + 1}": only[a:b].reset_index(drop=True)
        for i, (a, b) in enumerate(itertools.pairwise(cuts))
    }


if __name__ == "__main__":
    run("studies.real.__main__")
