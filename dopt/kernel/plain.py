"""The kernel's own text in the interpreter: ``DOPT_PLAIN=1`` for breakpoints and print().

Nothing is compiled: each function runs as Python reads it, some thousand times slower, and gives
the same numbers up to rounding. What only the compiler has is replaced here.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

PLAIN = os.environ.get("DOPT_PLAIN", "0") not in ("", "0")
"""True if the kernel runs in the interpreter. Set the variable before Python starts."""


def power_of_two(shifted: Any) -> Any:
    """Return 2^k for a float that holds the integer k in the lowest bits of its significand."""
    single = isinstance(shifted, np.float32)
    k = float(shifted) - (12582912.0 if single else 6755399441055744.0)
    return np.float32(2.0**k) if single else 2.0**k


def monotonic_microseconds() -> float:
    """Read the system's monotonic clock [µs]."""
    return 1e6 * time.perf_counter()


class Held(NamedTuple):
    """Stand-in for a structure that compiled code holds."""

    trial: Any = None
    steps: Any = None


def trial_in(held: Held) -> Any:
    """Return the trial that is held."""
    return held.trial


def or_plain(plain: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Use ``plain`` in the interpreter in place of a function that only the compiler has."""

    def chosen(compiled: Callable[..., Any]) -> Callable[..., Any]:
        if PLAIN:
            return plain
        compiled.plain = plain  # type: ignore[attr-defined]
        return compiled

    return chosen
