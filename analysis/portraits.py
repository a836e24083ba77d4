"""Figure 2, left and middle, as numbers: one trajectory of each policy in the phase plane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.choice import REFERENCE
from analysis.coverage import Box, coverage
from analysis.errors import AnalysisError
from analysis.phase import wrap, wrapped_line
from analysis.selection import Entry, Selection
from analysis.statistics import mean, standard_error
from dopt.systems import System, system_from_mapping
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


@dataclass(frozen=True)
class Plane:
    """The phase plane of a system: state indices, labels, which axes are angles, box."""

    axes: tuple[int, int]
    labels: tuple[str, str]
    angles: tuple[bool, bool]
    centres: tuple[float, float]
    box: Box

    def project(self, states: Array) -> Array:
        """Return the points (n, 2) of states (n, d), angles not wrapped."""
        return states[:, list(self.axes)]

    def line(self, points: Array) -> Array:
        """Return the line to draw through points (n, 2)."""
        for axis in range(2):
            if self.angles[axis]:
                points = wrapped_line(points, axis, self.centres[axis])
        return points

    def wrapped(self, points: Array) -> Array:
        """Return points (n, 2) with angles inside one turn around the centre."""
        inside = points.copy()
        for axis in range(2):
            if self.angles[axis]:
                inside[:, axis] = wrap(points[:, axis], self.centres[axis])
        return inside


@dataclass(frozen=True)
class Portraits:
    """All portraits of one environment, of the same seed."""

    env: str
    seed: int
    plane: Plane
    panels: tuple[Portrait, ...]


def phase_plane(system: System) -> Plane:
    """Return the phase plane of a system; angles are centred on its stable equilibrium.

    So small oscillations about it are not broken, wherever the angle is measured from. A box
    that covers the whole turn moves with the centre.
    """
    axes = system.phase_plane
    rest = system.equilibrium or (0.0,) * system.n_states
    angles = (axes[0] in system.angle_indices, axes[1] in system.angle_indices)
    centres = (
        rest[axes[0]] if angles[0] else 0.0,
        rest[axes[1]] if angles[1] else 0.0,
    )
    given = system.grid_box()
    sides = [
        _side(given[axis], centre) if turning else given[axis]
        for axis, centre, turning in zip(axes, centres, angles, strict=True)
    ]
    labels = (system.state_labels[axes[0]], system.state_labels[axes[1]])
    return Plane(axes, labels, angles, centres, (sides[0], sides[1]))


def _side(side: tuple[float, float], centre: float) -> tuple[float, float]:
    low, high = side
    if high - low > 2 * np.pi - 1e-9:
        return centre - np.pi, centre + np.pi
    shift = float(wrap(np.array((low + high) / 2), centre)) - (low + high) / 2
    return low + shift, high + shift


def median_seed(losses: dict[int, float]) -> int:
    """Return the seed with the median loss, the lower one of two; ties go to the lower seed."""
    ranked = sorted(losses, key=lambda seed: (losses[seed], seed))
    return ranked[(len(ranked) - 1) // 2]


def choose_seed(entries: Iterable[Entry]) -> int:
    """Return the seed to draw: that of the median among the reference policy's final losses."""
    for entry in entries:
        if entry.cell.policy == REFERENCE and entry.final_losses():
            return median_seed(entry.final_losses())
    raise AnalysisError(
        f"A phase portrait shows {SEED_RULE}, but no finished trial of {REFERENCE} is stored: "
        f"run one, or leave this figure out."
    )


def measure_portraits(reader: Reader, selection: Selection, env: str) -> Portraits:
    """Return the portraits of one environment."""
    entries = selection.of(env)
    seed = choose_seed(entries)
    plane = phase_plane(system_from_mapping(entries[0].cell.config["env"]))
    panels = tuple(_portrait(reader, entry, seed, plane) for entry in entries)
    return Portraits(env, seed, plane, panels)


def _portrait(reader: Reader, entry: Entry, seed: int, plane: Plane) -> Portrait:
    key, finished = entry.cell.config_key, entry.finished
    status = {trial.seed: trial.status for trial in finished}
    points = np.empty((0, 2))
    if seed in status:
        points = plane.project(reader.trajectory(key, seed).states)
        points = points[np.isfinite(points).all(axis=1)]
    shares = np.array([_share(reader, key, seed, plane) for seed in entry.final_losses()])
    return Portrait(
        policy=entry.cell.policy,
        line=plane.line(points) if len(points) else points,
        start=plane.wrapped(points[:1])[0] if len(points) else np.full(2, np.nan),
        diverged=status.get(seed) == "diverged",
        coverage=float(mean(shares)),
        coverage_error=float(standard_error(shares)),
        n=len(shares),
        n_diverged=len(finished) - len(shares),
    )


def _share(reader: Reader, key: str, seed: int, plane: Plane) -> float:
    points = plane.project(reader.trajectory(key, seed).states)
    return coverage(plane.wrapped(points), plane.box)


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
