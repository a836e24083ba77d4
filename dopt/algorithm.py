"""Codes and tolerances that several modules share, most of them of the compiled kernel."""

from __future__ import annotations

from enum import IntEnum


class ModelKind(IntEnum):
    """Model that the kernel evaluates."""

    MLP = 0
    LINEAR = 1
    RANDOM_FEATURES = 2
    GAUSSIAN_PROCESS = 3
    LINEAR_STATE = 4
    GREY_BOX = 5


class FeatureKind(IntEnum):
    """Function of one state component that a feature is."""

    IDENTITY = 0
    COS = 1
    SIN = 2


class Form(IntEnum):
    """Representation of the information matrix (:class:`dopt.policies.d_optimal.DOptimal`)."""

    PRIMAL = 0
    DUAL = 1
    SKETCH = 2


class Score(IntEnum):
    """Criterion of a plan of a searching policy (:mod:`dopt.policies.search`)."""

    JOINT = 0
    SUM = 1
    TRACE = 2
    A = 3
    E = 4
    TASK = 5


class Integrator(IntEnum):
    """Method that integrates the equation of motion over a time step."""

    EULER = 0
    RK4 = 1


RUNGE_KUTTA_SHARES = (0.5, 0.5, 1.0)
"""Parts of a step after which the derivative is asked for again."""

RUNGE_KUTTA_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
"""Weights of the derivatives in their mean."""

TIE_MARGIN = 1e-9
"""Values that differ by less than this relative margin are equal: rounding must not choose."""

SMALLEST_SHARE = 1.0 / 64.0
"""Smallest share of a Gauss-Newton step that is tried."""

NO_GROWTH = 1.0 + 1e-10
"""Growth of a sum of squares that counts as none: at its minimum rounding must not decide."""
