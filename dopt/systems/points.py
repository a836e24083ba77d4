"""Evenly spread points of a cube in many dimensions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError


def check_number(n: int) -> None:
    """Refuse a number of points of a low-discrepancy set.

    Raises
    ------
    SpecificationError
        If n is not a power of two: other numbers of points are spread less evenly.
    """
    if n & (n - 1):
        raise SpecificationError(
            f"env.grid_points is [{n}], but a power of two is expected for a low-discrepancy set: "
            f"set it to {2 ** (n.bit_length() - 1)} or {2 ** n.bit_length()}."
        )


def sobol_midpoints(dimensions: int, n: int) -> npt.NDArray[np.float64]:
    """Return the first n points of a Sobol sequence in the unit cube, (n, dimensions).

    They are moved by half of 1/n, so that along every axis they are the n midpoints of a regular
    partition, each once. Reference: I. Sobol, "On the distribution of points in a cube and the
    approximate evaluation of integrals" (1967), with the direction numbers of S. Joe and F. Kuo,
    "Constructing Sobol sequences with better two-dimensional projections" (2008).

    Raises
    ------
    SpecificationError
        If :func:`check_number` refuses n.
    """
    from scipy.stats import qmc  # its import takes longer than a short trial

    check_number(n)
    points: npt.NDArray[np.float64] = qmc.Sobol(dimensions, scramble=False).random(n)
    return points + 0.5 / n
