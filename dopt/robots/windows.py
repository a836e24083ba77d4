"""Windows of samples, each an equation of motion, and intervals that hold at all times at once.

The intervals come from a normal mixture with a delayed start: H. Robbins, "Statistical methods
related to the law of the iterated logarithm", Ann. Math. Stat. 41, 5 (1970); S. R. Howard et al.,
"Time-uniform, nonparametric, nonasymptotic confidence sequences", Ann. Stat. 49, 2 (2021); for one
of several coefficients M. Lindon et al., "Anytime-valid linear models" (arXiv:2210.08589). Inputs
that depend on what was learned are not covered by the last one: ``studies/robots/online.py``
measures how often the intervals hold.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from dopt.robots.limits import Limits
from dopt.types import Array

WINDOW = 20, 100
"""Least and most periods of control in a window, whose samples become one equation a joint."""

ENCODER, TORQUE_NOISE = 2.8e-5, 0.01
"""Errors expected of a position [rad], 16 bits, and of a torque, as a part of its limit."""

EARLY = 1.3
"""Factor of the intervals while the information at the stop is not known."""


class Window:
    """Weights that make one equation of the samples of a window.

    A second-order polynomial through the positions q_0 … q_N by least squares has an acceleration
    c·q, which is also Σ w_i q̈_i over second differences. Torques, positions and rates averaged by
    the same w obey the same equation of motion.
    """

    def __init__(self, dt: float, size: int = WINDOW[0]) -> None:
        t = dt * (np.arange(size + 1) - size / 2)
        self.acceleration = np.linalg.pinv(np.stack([np.ones_like(t), t, t**2 / 2], axis=1))[2]
        self.weights = np.zeros(size + 1)
        self.weights[1:-1] = dt**2 * np.cumsum(np.cumsum(self.acceleration))[:-2]
        # A torque acts until the next sample: half of it in each of two second differences.
        self.of_torques = np.zeros(size + 1)
        self.of_torques[:-1] = 0.5 * (self.weights[:-1] + self.weights[1:])
        rates = np.zeros(size + 1)
        rates[2:] += self.weights[1:-1] / (2 * dt)
        rates[:-2] -= self.weights[1:-1] / (2 * dt)
        self.rate, self.times, self.size, self.seconds = rates, t, size, size * dt

    def means(self, positions: Array, torques: Array) -> tuple[Array, Array, Array, Array]:
        """Return position, rate, acceleration and torque, each (n,), of samples (N + 1, n)."""
        return (
            self.weights @ positions,
            self.rate @ positions,
            self.acceleration @ positions,
            self.of_torques @ torques,
        )


def window_size(inertia: Array, limits: Limits, dt: float) -> int:
    """Return the periods after which errors of encoders add a half to the noise of torques.

    Least squares over N periods leave σ √(720/N⁵)/dt² in an acceleration, and 1.2 σ/√N in a torque.

    Parameters
    ----------
    inertia : (n,)
        Largest inertia of each joint [kg m²].
    """
    size = 720.0 * (inertia / limits.torque * ENCODER / (dt**2 * TORQUE_NOISE)) ** 2 / (0.5 * 1.43)
    return int(np.clip(2 * np.ceil(size.max() ** 0.25 / 2), *WINDOW))


def boundary(level: float) -> float:
    """Return a with 4 (1 - Φ(a)) + 2 a φ(a) = level.

    |S| ≤ a √m until the information I reaches m, and |S| ≤ √(I (a² + ln(I/m))) ever after, are
    together kept with probability 1 - level by a sum S of variance I: Robbins (1970) from m on,
    and by reflection before.
    """
    return float(
        brentq(lambda a: 4.0 * norm.sf(a) + 2.0 * a * norm.pdf(a) - level, 1.0, 9.0, xtol=1e-9)
    )


def half_widths(errors: Array, expected: Array | None, a: float) -> Array:
    """Return half-widths that hold at all times, of standard errors and information expected.

    Before that is known, they are wider by :data:`EARLY`.
    """
    if expected is None:
        return EARLY * a * errors
    information = 1.0 / np.maximum(errors, 1e-300) ** 2
    later = np.sqrt((a**2 + np.log(np.maximum(information / expected, 1.0))) / information)
    return np.where(information < expected, a * np.sqrt(expected) / information, later)
