"""Garbage collection in programs: seldom, because what they make on the way mostly stays.

Python searches for unreachable cycles after every 700 new containers. A program that imports large
libraries and compiles makes very many that stay until its end, and spent a sixth of a short run on
such searches.
"""

from __future__ import annotations

import gc

NEW_CONTAINERS = 100_000
"""Containers that are made between two searches."""


def collect_rarely() -> None:
    """Let this process search for unreachable cycles less often.

    For programs, early, as imports gain most; a library leaves the setting to its user.
    """
    gc.set_threshold(NEW_CONTAINERS)
