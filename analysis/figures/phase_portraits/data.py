"""Figure 2, left and middle, as numbers: one trajectory of each policy in the phase plane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.config_matching import REFERENCE
from analysis.data.trial_selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.figures.phase_portraits.angles import wrapped_line
from analysis.stats.intervals import mean, standard_error
from dopt.coverage import Plane
from dopt.spec.prequential import system_of
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]

SEED_RULE = "the seed whose D-optimal final loss is the median (the lower one of two)"


@dataclass(frozen=True)
class Portrait:
    """The trajectory of one policy, and how much of the box its trials visit.

    Attributes
    ----------
    line : (n, 2)
        Drawn points: angles wrapped, rows of NaN where the line is broken. Empty when the policy
        has no finished trial of that seed.
    start : (2,)
    diverged : bool
    coverage, coverage_error : float
        Mean share of visited cells over the trials that did not diverge, and its standard error.
    n, n_diverged : int
        Trials in that mean, and trials left out of it.
    """

    policy: str
    line: Array
    start: Array
    diverged: bool
    coverage: float
    coverage_error: float
    n: int
    n_diverged: int


class DrawnPlane(Plane):
    """A phase plane and the lines in it."""

    def line(self, points: Array) -> Array:
        """Return the line to draw through points (n, 2)."""
        for axis in range(2):
            if self.angles[axis]:
                points = wrapped_line(points, axis, self.centres[axis])
        return points


@dataclass(frozen=True)
class Portraits:
    """All portraits of one environment, of the same seed."""

    env: str
    seed: int
    plane: DrawnPlane
    panels: tuple[Portrait, ...]


def median_seed(losses: dict[int, float]) -> int:
    """Return the seed with the median loss, the lower one of two; ties go to the lower seed."""
    ranked = sorted(losses, key=lambda seed: (losses[seed], seed))
    return ranked[(len(ranked) - 1) // 2]


def choose_seed(entries: Iterable[Entry]) -> int:
    """Return the seed to draw: that of the median among the reference policy's final losses."""
    for entry in entries:
        if entry.config.policy == REFERENCE and entry.final_losses():
            return median_seed(entry.final_losses())
    raise AnalysisError(
        f"A phase portrait shows {SEED_RULE}, but no finished trial of {REFERENCE} is stored: "
        f"run one, or leave this figure out."
    )


def measure_portraits(reader: Reader, selection: Selection, env: str) -> Portraits:
    """Return the portraits of one environment."""
    entries = selection.of(env)
    seed = choose_seed(entries)
    plane = DrawnPlane.of(system_of(entries[0].config.config))
    panels = tuple(_portrait(reader, entry, seed, plane) for entry in entries)
    return Portraits(env, seed, plane, panels)


def _portrait(reader: Reader, entry: Entry, seed: int, plane: DrawnPlane) -> Portrait:
    key, finished = entry.config.config_key, entry.finished
    status = {trial.seed: trial.status for trial in finished}
    points = np.empty((0, 2))
    if seed in status:
        points = plane.project(reader.trajectory(key, seed).states)
        points = points[np.isfinite(points).all(axis=1)]
    shares = np.array([_share(reader, key, seed, plane) for seed in entry.final_losses()])
    return Portrait(
        policy=entry.config.policy,
        line=plane.line(points) if len(points) else points,
        start=plane.wrapped(points[:1])[0] if len(points) else np.full(2, np.nan),
        diverged=status.get(seed) == "diverged",
        coverage=float(mean(shares)),
        coverage_error=float(standard_error(shares)),
        n=len(shares),
        n_diverged=len(finished) - len(shares),
    )


def _share(reader: Reader, key: str, seed: int, plane: DrawnPlane) -> float:
    return plane.coverage(reader.trajectory(key, seed).states)


def tabulate_portraits(portraits: Portraits) -> pd.DataFrame:
    """Return what is drawn, one row for each point of a line; empty fields break the line."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "env": portraits.env,
                    "policy": panel.policy,
                    "seed": portraits.seed,
                    "x": panel.line[:, 0],
                    "y": panel.line[:, 1],
                    "coverage": panel.coverage,
                    "coverage_se": panel.coverage_error,
                    "n": panel.n,
                    "n_diverged": panel.n_diverged,
                }
            )
            for panel in portraits.panels
        ],
        ignore_index=True,
    )
