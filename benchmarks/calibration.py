"""Fixed work by which measured times of different machines, or of a busy one, are compared."""

from __future__ import annotations

import time
from statistics import median

import numpy as np

ROUNDS = 9


def seconds() -> float:
    """Return the median time of a loop of the interpreter and of dense algebra, about 10 ms each.

    Both are what the measured code is made of. The work is never changed: a history would lose its
    measure.
    """
    return median(_timed() for _ in range(ROUNDS))


def _timed() -> float:
    start = time.perf_counter()
    _interpret()
    _factorise()
    return time.perf_counter() - start


def _interpret() -> int:
    counts: dict[int, int] = {}
    for i in range(100_000):
        counts[i % 97] = counts.get(i % 97, 0) + i
    return sum(counts.values())


def _factorise() -> float:
    at = np.linspace(0.0, 1.0, 128)
    matrix = np.exp(-8.0 * np.square(at[:, None] - at)) + np.eye(128)
    for _ in range(40):
        matrix = np.tanh(np.linalg.cholesky(matrix @ matrix.T + np.eye(128)))
    return float(matrix.sum())
