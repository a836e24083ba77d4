"""Waiting for events, never for an amount of time: a machine may be as slow as it likes."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_SECONDS = 600.0
"""Longest wait for an event that must come; only a defect takes so long."""


def until(
    condition: Callable[[], object], what: Callable[[], str] = lambda: "it did not happen"
) -> None:
    """Wait for the condition; ``what`` tells what there is in place of it."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not condition():
        assert time.monotonic() < end, what()
        time.sleep(0.02)
