"""Trajectories as numbers: lines in a phase plane, and the power spectral density of inputs.

=======  =============================================  =========
symbol   meaning                                        shape
=======  =============================================  =========
u        inputs of n trials, T steps, m components      (n, T, m)
f        frequencies 0 ... 1/(2 dt) [Hz]                (F,)
S        one-sided density, summed over components      (n, F)
=======  =============================================  =========
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.assessment import TURN, Plane, turns, wrap

Array = npt.NDArray[np.float64]
QUANTILES = (0.1, 0.9)


def wrapped_line(line: Array, axis: int, centre: float = 0.0) -> Array:
    """Wrap one coordinate of a line, (n, 2) -> (n', 2), and break the line where it jumps.

    Where the angle leaves on one side and comes back on the other, the line is drawn up to the
    edge, a row of NaN breaks it, and it goes on from the opposite edge. A step of more than one
    turn is a break without edges: between the two samples nothing is known.
    """
    count = turns(line[:, axis], centre)
    pieces = [_wrapped(line[:1], axis, centre)]
    for before, after, jump in zip(line[:-1], line[1:], np.diff(count), strict=True):
        if jump:
            pieces.append(_crossing(before, after, axis, centre, jump))
        pieces.append(_wrapped(after[None], axis, centre))
    return np.concatenate(pieces)


def _wrapped(line: Array, axis: int, centre: float) -> Array:
    inside = line.copy()
    inside[:, axis] = wrap(line[:, axis], centre)
    return inside


def _crossing(before: Array, after: Array, axis: int, centre: float, jump: float) -> Array:
    """Return the rows edge, NaN, opposite edge between two samples (2,) on different turns."""
    gap = np.full((1, 2), np.nan)
    if abs(jump) != 1:
        return gap
    edge = centre + math.pi + TURN * float(turns(before[axis], centre) - (jump < 0))
    share = (edge - before[axis]) / (after[axis] - before[axis])
    leaving, entering = (before + share * (after - before) for _ in range(2))
    leaving[axis], entering[axis] = centre + jump * math.pi, centre - jump * math.pi
    return np.concatenate([leaving[None], gap, entering[None]])


class DrawnPlane(Plane):
    """A phase plane and the lines in it."""

    def line(self, points: Array) -> Array:
        """Return the line to draw through points (n, 2)."""
        for axis in range(2):
            if self.angles[axis]:
                points = wrapped_line(points, axis, self.centres[axis])
        return points


@dataclass(frozen=True)
class Spectrum:
    """Mean over trials and the 10 % and 90 % quantiles across them, each (F,)."""

    frequency: Array
    mean: Array
    low: Array
    high: Array
    n: int


def periodogram(inputs: Array, dt: float) -> tuple[Array, Array]:
    """Return f [Hz] and S [unit² / Hz] of inputs (n, T, m) sampled every dt seconds.

    Neither window nor detrending: the sum of S times the spacing of f is the mean square of u
    (Parseval).
    """
    from scipy import signal  # its import takes longer than most commands

    frequency, density = signal.periodogram(
        inputs, fs=1 / dt, window="boxcar", detrend=False, scaling="density", axis=1
    )
    return np.asarray(frequency, dtype=float), np.asarray(density, dtype=float).sum(axis=2)


def average_spectrum(inputs: Array, dt: float) -> Spectrum:
    """Return mean and quantiles over trials of the periodograms of inputs (n, T, m)."""
    frequency, density = periodogram(inputs, dt)
    low, high = np.quantile(density, QUANTILES, axis=0)
    return Spectrum(frequency, np.mean(density, axis=0), low, high, len(density))


def median_seed(losses: dict[int, float]) -> int:
    """Return the seed with the median loss, the lower one of two; ties go to the lower seed."""
    ranked = sorted(losses, key=lambda seed: (losses[seed], seed))
    return ranked[(len(ranked) - 1) // 2]
