"""Elementary functions over floats, complex numbers, arrays and tensors alike.

The equations of a system are written once over these; the compiled kernel replaces each by the
machine's own (:mod:`dopt.kernel.equations`).
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np


def sin(x: Any) -> Any:
    """Sine of an angle in radians."""
    return _apply(x, "sin")


def cos(x: Any) -> Any:
    """Cosine of an angle in radians."""
    return _apply(x, "cos")


def magnitude(x: Any) -> Any:
    """Absolute value of a real quantity, continued to complex arguments along the real axis.

    For complex x it is x or -x, by the sign of the real part, so that a complex step gives the
    derivative.
    """
    if isinstance(x, complex | np.complexfloating):
        return x if x.real >= 0 else -x
    return abs(x)


def _apply(x: Any, name: str) -> Any:
    if isinstance(x, float | int):
        return getattr(math, name)(x)
    if isinstance(x, complex):
        return getattr(cmath, name)(x)
    if isinstance(x, np.ndarray | np.generic):
        return getattr(np, name)(x)
    return getattr(x, name)()
