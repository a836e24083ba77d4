"""Lines in a phase plane whose axes may be angles."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from dopt.coverage import TURN, turns, wrap

Array = npt.NDArray[np.float64]


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
