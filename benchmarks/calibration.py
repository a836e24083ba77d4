"""Fixed work by which measured times of different machines, or of a busy one, are compared.

Each section of it is as short as what is measured, and the quickest one counts: another process
interrupts long sections on a busy machine, short ones seldom. The work is never changed: a history
would lose its measure.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

SECTIONS = 40


def algebra() -> None:
    """Do dense algebra for some 0.2 ms, as the kernel does."""
    np.tanh(np.linalg.cholesky(_MATRIX @ _MATRIX.T + _IDENTITY))


def interpreter() -> None:
    """Run the interpreter for some 0.2 ms, as programs do."""
    counts: dict[int, int] = {}
    for i in range(3_000):
        counts[i % 97] = counts.get(i % 97, 0) + i


def seconds(work: Callable[[], None] = algebra) -> float:
    """Return the time of the quickest section."""
    return min(_timed(work) for _ in range(SECTIONS))


def _timed(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


_AT = np.linspace(0.0, 1.0, 128)
_IDENTITY = np.eye(128)
_MATRIX = np.exp(-8.0 * np.square(_AT[:, None] - _AT)) + _IDENTITY
