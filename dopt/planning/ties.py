"""When two inputs are equally good."""

from __future__ import annotations

TIE_MARGIN = 1e-9
"""Values that differ by less than this relative margin are equal: rounding must not choose."""
