"""One time step of a differential equation with a held input: the Euler map, or Runge-Kutta."""

from __future__ import annotations

from collections.abc import Callable

from dopt.algorithm import RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS, Integrator
from dopt.types import Scalar

INTEGRATORS = tuple(integrator.name.lower() for integrator in Integrator)


def next_state(integrator: str, rate: Callable[[Scalar], Scalar], x: Scalar, dt: float) -> Scalar:
    """Return the state dt seconds after x, for arrays and tensors alike.

    ``rate`` is dx/dt. With "rk4" it is the classical method of Runge and Kutta of fourth order.
    """
    slope = rate(x)
    if integrator == Integrator.EULER.name.lower():
        return x + dt * slope
    total = RUNGE_KUTTA_WEIGHTS[0] * slope
    for share, weight in zip(RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS[1:], strict=True):
        slope = rate(x + share * dt * slope)
        total = total + weight * slope
    return x + dt * total
