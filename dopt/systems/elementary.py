"""Elementary functions over floats, complex numbers, arrays and tensors alike.

The equations of a system are written once over these; the compiled kernel replaces each by the
machine's own (:mod:`dopt.kernel.equations`). A complex argument belongs to a complex step, which
takes derivatives: what is not smooth, :func:`magnitude`, :func:`sign` and :func:`where`, follows
the real part.
"""

from __future__ import annotations

import cmath
import math
import sys

import numpy as np

from dopt.types import Scalar


def sin(x: Scalar) -> Scalar:
    """Sine of an angle in radians."""
    return _apply(x, "sin")


def cos(x: Scalar) -> Scalar:
    """Cosine of an angle in radians."""
    return _apply(x, "cos")


def tanh(x: Scalar) -> Scalar:
    """Hyperbolic tangent; dry friction without a jump is ``-c * tanh(v / v_c)``."""
    return _apply(x, "tanh")


def magnitude(x: Scalar) -> Scalar:
    """Absolute value of a real quantity, continued to complex arguments along the real axis.

    For complex x it is x or -x, by the sign of the real part, so that a complex step gives the
    derivative.
    """
    if isinstance(x, complex | np.complexfloating):
        return x if x.real >= 0 else -x
    if isinstance(x, np.ndarray) and np.iscomplexobj(x):
        return np.where(x.real >= 0, x, -x)
    return abs(x)


def sign(x: Scalar) -> Scalar:
    """Sign of a real quantity, -1, 0 or 1; of a complex one, the sign of its real part.

    Its derivative is 0. Dry friction is ``-c * sign(v)``. ``numpy.sign`` of a complex number is
    x / |x|, from which a complex step takes another derivative.
    """
    if isinstance(x, float | int | complex):
        return float(x.real > 0) - float(x.real < 0) if not math.isnan(x.real) else math.nan
    if isinstance(x, np.ndarray | np.generic):
        return np.sign(x.real) + 0 * x.imag if np.iscomplexobj(x) else np.sign(x)
    return x.sign()


def where(condition: Scalar, first: Scalar, second: Scalar) -> Scalar:
    """Return ``first`` where a condition holds and ``second`` elsewhere, as ``where(v > 0, a, b)``.

    Both are computed. The condition compares states and parameters; of complex states it compares
    the real parts.
    """
    if isinstance(condition, bool | np.bool_):
        return first if condition else second
    library: Scalar = sys.modules[type(condition).__module__.partition(".")[0]]
    return library.where(condition, first, second)


def _apply(x: Scalar, name: str) -> Scalar:
    if isinstance(x, float | int | complex):
        try:
            return getattr(cmath if isinstance(x, complex) else math, name)(x)
        except ValueError:  # of an infinite argument, of which arrays and compiled code give NaN
            return math.nan
    if isinstance(x, np.ndarray | np.generic):
        return getattr(np, name)(x)
    return getattr(x, name)()
