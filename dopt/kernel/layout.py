"""Layout of arguments of compiled code, by which their types for Numba are told apart."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np


def layout_of(value: object) -> Hashable:
    """Return what the type of an argument for Numba depends on, which takes longer to find out."""
    if isinstance(value, tuple):
        return (type(value), *map(layout_of, value))
    if isinstance(value, np.ndarray):
        return value.dtype.char, value.ndim, value.flags.num
    return type(value) if isinstance(value, (int, float)) else value
