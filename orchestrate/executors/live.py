"""Samples of the losses of running tasks, on the side of the process that runs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from math import isfinite

from dopt.types import Array
from dopt.watching import watched
from orchestrate.records import Sample

Report = Callable[[Sample], None]
"""Function that takes a sample of a running task."""


@dataclass(frozen=True)
class Live:
    """Time between two samples of a running task [s], and the function that takes them."""

    seconds: float
    report: Report


def sampled(keys: Sequence[str], live: Live | None) -> AbstractContextManager[None]:
    """Report the losses of the tasks with these keys, which the block runs together."""
    if live is None:
        return nullcontext()

    def tell(t: int, loss: Array, reachable_loss: Array) -> None:
        for key, one, other in zip(keys, loss, reachable_loss, strict=True):
            if isfinite(one):
                live.report(Sample(key, t, float(one), float(other)))

    return watched(live.seconds, tell)
