"""Friction of a robot's joints, learned from what its known body does not explain.

What is learned is the missing torque τ - ID(q, q̇, q̈) of each joint as a function of its own rate:
the information is one block a joint. Torques are learned as parts x of the torque limit, rates as
parts of the velocity limit. Torque that depends on the position (ripple) is a nuisance: a random
function with 10 to 40 periods a turn, whose coefficients are learned and told apart from friction.

Samples are taken together in windows, each an equation of motion. The intervals hold at all times
at once, by a normal mixture with a delayed start: H. Robbins, "Statistical methods related to the
law of the iterated logarithm", Ann. Math. Stat. 41, 5 (1970); S. R. Howard et al., "Time-uniform,
nonparametric, nonasymptotic confidence sequences", Ann. Stat. 49, 2 (2021); for one of several
coefficients M. Lindon et al., "Anytime-valid linear models" (arXiv:2210.08589). Inputs that depend
on what was learned are not covered by the last one: ``studies/robots/online.py`` measures how often
the intervals hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from dopt.errors import unknown_name
from dopt.robots.limits import Limits
from dopt.types import Array

WINDOW = 20, 100
"""Least and most periods of control in a window, whose samples become one equation a joint."""

ENCODER, TORQUE_NOISE = 2.8e-5, 0.01
"""Errors expected of a position [rad], 16 bits, and of a torque, as a part of its limit."""

EARLY = 1.3
"""Factor of the intervals while the information at the stop is not known."""

SLOW = 0.01
"""Windows in which a joint is slower than this part of its limit teach nothing of its friction."""

STUCK = 0.005
"""Rate, as a part of its limit, below which a joint sticks though its reference moves."""

SPEEDS = np.geomspace(0.02, 0.95, 12)
"""Parts of the velocity limit at which the friction curve is judged."""

RIPPLE = np.arange(10.0, 41.0)
"""Periods a turn, or in 2π m, of torque that depends on the position."""

RIPPLE_SIZE = 1.5
"""Standard deviation of the ripple before any sample, in units of a window's noise."""

NOISE = 0.003
"""Standard deviation of a window's torque before any sample, as a part of the limit."""

NEAR = 1.4
"""Multiple of the width asked for from which the stop is near."""

BATCH = 10
"""Windows in a batch, whose means show how far innovations are correlated."""

MISSED = 0.05
"""Probability that an interval misses."""

SIGN = 0.003
"""Width in which dry friction is taken to change its sign."""


class CoulombViscous:
    """Coulomb and viscous friction, and Stribeck terms of fixed widths: linear in its parameters.

    The parameters are the Coulomb torque, the viscous torque at the velocity limit, and heights.
    They begin at ``start``, (n, p), with standard deviations ``spread``, (p,); rates x are (n, k).
    """

    widths = np.array([0.015, 0.03, 0.06])
    spread = np.array([0.1, 0.1, 0.015, 0.015, 0.015])

    def __init__(self, n: int, seed: int = 0) -> None:  # noqa: ARG002  # zeros for any seed
        self.start = np.zeros((n, len(self.spread)))

    def torques(self, parameters: Array, x: Array) -> Array:
        return np.asarray(np.einsum("nkp,np->nk", self.jacobian(parameters, x), parameters))

    def jacobian(self, parameters: Array, x: Array) -> Array:  # noqa: ARG002  # linear in them
        sign = np.tanh(x / SIGN)
        heights = sign[..., None] * np.exp(-((x[..., None] / self.widths) ** 2))
        return np.concatenate([sign[..., None], x[..., None], heights], axis=2)


class Network:
    """Network of 7 tanh units of the rate: f(x) = d + Σ_k c_k tanh(s_k x + b_k), 22 parameters.

    The parameters are c, ln s, b and d; the scales s begin spread from dry friction to viscous.
    """

    scales = np.array([100.0, 50.0, 25.0, 12.0, 5.0, 2.0, 0.7])
    heights = (0.06, 0.015, 0.015, 0.015, 0.03, 0.06, 0.1)
    spread = np.concatenate([heights, np.full(7, 0.15), np.full(7, 0.05), [0.003]])

    def __init__(self, n: int, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.start = np.zeros((n, 22))
        self.start[:, :7] = random.uniform(0.0005, 0.001, (n, 7))
        self.start[:, 7:14] = np.log(self.scales)

    def torques(self, parameters: Array, x: Array) -> Array:
        t = self.jacobian(parameters, x)[..., :7]
        return np.asarray((parameters[:, None, :7] * t).sum(axis=2) + parameters[:, 21:])

    def jacobian(self, parameters: Array, x: Array) -> Array:
        c, s = parameters[:, None, :7], np.exp(parameters[:, None, 7:14])
        t = np.tanh(s * x[..., None] + parameters[:, None, 14:21])
        bent = c * (1.0 - t**2)
        return np.concatenate([t, bent * s * x[..., None], bent, np.ones((*x.shape, 1))], axis=2)


FRICTION: dict[str, type[CoulombViscous | Network]]
FRICTION = {"coulomb_viscous": CoulombViscous, "network": Network}
"""Models of friction, by their names, of n joints and a seed."""


class FrictionLearner:
    """Recursive least squares of friction and ripple, one block a joint, by windows of samples.

    A network is linearised at its present parameters: an extended Kalman filter at rest.

    Parameters
    ----------
    limits : Limits
    inverse : function
        Torques of the known body, (n,), at position, velocity and acceleration, each (n,).
    friction : str
        A key of ``FRICTION``.
    dt : float
        Period of control [s].
    relative : float
        Half-width of the curve's interval that is asked for, relative to the curve's root mean
        square: the intervals are narrowest there.
    seed : int
        Seed of the network's first parameters.
    window : int
        Periods of control in a window.

    Attributes
    ----------
    unit : (n,)
        Deviation that was expected of the last window's innovations, as a part of the limit.
    """

    unit: Array

    def __init__(
        self,
        limits: Limits,
        inverse: Callable[[Array, Array, Array], Array],
        friction: str = "coulomb_viscous",
        dt: float = 0.002,
        relative: float = 0.05,
        seed: int = 0,
        window: int = WINDOW[0],
    ) -> None:
        if friction not in FRICTION:
            raise unknown_name("friction", friction, FRICTION)
        n = len(limits.torque)
        self.limits, self.window, self._inverse = limits, Window(dt, window), inverse
        self.model = FRICTION[friction](n, seed)
        self.n, self.p = n, self.model.start.shape[1]
        spread = self.model.spread / NOISE
        ripple = np.full(2 * len(RIPPLE), RIPPLE_SIZE / math.sqrt(len(RIPPLE)))
        self.mean = np.concatenate([self.model.start, np.zeros((n, len(ripple)))], axis=1)
        self._prior = np.diag(np.concatenate([spread, ripple]) ** 2)
        self.covariance = np.tile(self._prior, (n, 1, 1))
        self._squares = np.full((2, n), [[10.0 * NOISE**2], [10.0]])
        self._batches, self._pending = np.full((2, n), 10.0), np.zeros((2, n))
        self.boundary, self.relative = boundary(MISSED), relative
        self._expected: Array | None = None
        self.windows = np.zeros(n, dtype=int)

    @property
    def noise(self) -> Array:
        """Standard deviation of a window's torque, (n,), as a part of the limit."""
        return np.asarray(np.sqrt(self._squares[0] / self._squares[1]))

    @property
    def inflation(self) -> Array:
        """Variance of means of innovations relative to uncorrelated ones, (n,), at least 1."""
        return np.asarray(np.maximum(1.0, self._batches[0] / self._batches[1]))

    def torques(self, velocities: Array) -> Array:
        """Return friction as it was learned [N m], (n,), at velocities (n,)."""
        x = (velocities / self.limits.velocity)[:, None]
        return self.model.torques(self.mean[:, : self.p], x)[:, 0] * self.limits.torque

    def feedforward(self, velocities: Array) -> Array:
        """Return friction to feed forward [N m], (n,), at velocities (n,).

        It is what was learned, less its standard error: too much of it drives a joint too fast.
        """
        x = (velocities / self.limits.velocity)[:, None]
        parameters = self.mean[:, : self.p]
        value = self.model.torques(parameters, x)[:, 0]
        rows = self.model.jacobian(parameters, x)
        variance = (rows @ self.covariance[:, : self.p, : self.p] * rows).sum(axis=(1, 2))
        size = np.abs(value) - self.noise * np.sqrt(np.maximum(variance, 0.0))
        return np.asarray(np.sign(value) * np.maximum(size, 0.0) * self.limits.torque)

    def innovations(
        self, means: tuple[Array, Array, Array, Array], rates: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return e, H and its prior variance in units of noise: (n,), (n, d) and (n,).

        Where a joint is too slow, e is NaN and H zero. Arguments as of :meth:`learn`.
        """
        q, v, a, torque = means
        times, limit = self.window.times[1:-1], self.limits.velocity
        within = (v + times[:, None] * a) / limit
        x = within if rates is None else rates[1:] / limit
        way = np.sign(x.sum(axis=0))
        moving = ((x * way).min(axis=0) > SLOW) & ((within * way).min(axis=0) > STUCK)
        within = within.T
        weights = self.window.weights[1:-1]
        parameters = self.mean[:, : self.p]
        mean = self.model.torques(parameters, within) @ weights
        rows = weights @ self.model.jacobian(parameters, within)
        angles = q[:, None] * RIPPLE
        features = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
        missing = (torque - self._inverse(q, v, a)) / self.limits.torque
        missing = missing - mean - (features * self.mean[:, self.p :]).sum(axis=1)
        rows = np.concatenate([rows, features], axis=1) * moving[:, None]
        variance = (rows * self._spread(rows)).sum(axis=1)
        return np.where(moving, missing, np.nan), rows, variance

    def _spread(self, rows: Array) -> Array:
        return np.squeeze(self.covariance @ rows[..., None], 2)

    def learn(self, means: tuple[Array, Array, Array, Array], rates: Array | None = None) -> Array:
        """Learn from a window; return its standardised innovations, (n,), NaN where it is slow.

        Parameters
        ----------
        means : tuple of (n,)
            As :meth:`Window.means` returns them.
        rates : (N, n), optional
            Velocities of the reference, which tell whether a joint is too slow: measured ones are
            the lower, the larger the noise was, and leave a biased choice of windows.
        """
        missing, rows, variance = self.innovations(means, rates)
        moving = np.isfinite(missing)
        error = np.where(moving, missing, 0.0)
        standard = error / np.sqrt(1.0 + variance)
        self.unit = self.noise * np.sqrt(1.0 + variance)
        result = np.where(moving, standard / self.noise, np.nan)
        spread = self._spread(rows)
        # New arrays: a shallow copy keeps what was known before.
        self.mean = self.mean + spread * (error / (1.0 + variance))[:, None]
        taken = spread[:, :, None] * spread[:, None, :] / (1.0 + variance)[:, None, None]
        self.covariance = self.covariance - taken
        self._squares = self._squares + np.where(moving, [standard**2, np.ones(self.n)], 0.0)
        pending = self._pending + np.where(moving, [np.nan_to_num(result), np.ones(self.n)], 0.0)
        full = pending[1] >= BATCH
        batch = np.where(full, [pending[0] ** 2 / BATCH, np.ones(self.n)], 0.0)
        self._batches, self._pending = self._batches + batch, np.where(full, 0.0, pending)
        self.windows = self.windows + moving
        return result

    def restore(self, before: FrictionLearner) -> None:
        """Return to an earlier shallow copy of this learner."""
        vars(self).update(vars(before))

    def forget(self, factor: float) -> None:
        """Multiply the errors of friction: the body that it was learned with has changed."""
        of = np.where(np.arange(self.mean.shape[1]) < self.p, factor, 1.0)
        self.covariance = self.covariance * np.outer(of, of)
        self._expected = None

    def rows(self, speeds: Array) -> Array:
        """Return the gradients of the curve at speeds, and of the two constants, (n, k + 2, p)."""
        return self._of(self.model.jacobian, speeds)

    def _values(self, speeds: Array) -> Array:
        return self._of(self.model.torques, speeds)

    def _of(self, function: Callable[[Array, Array], Array], speeds: Array) -> Array:
        """Return a function of the curve at speeds, and of the two constants, (n, k + 2, ...).

        Coulomb and viscous friction are the line through the friction at half of the velocity limit
        and at it: Stribeck friction is over there.
        """
        x = np.tile(np.concatenate([speeds, [0.5, 1.0]]), (self.n, 1))
        columns = function(self.mean[:, : self.p], x)
        half, full = columns[:, -2].copy(), columns[:, -1].copy()
        columns[:, -2], columns[:, -1] = 2.0 * half - full, 2.0 * (full - half)
        return columns

    def deviations(self, speeds: Array = SPEEDS) -> Array:
        """Return standard errors as parts of the torque limit, (n, k + 2), as :meth:`intervals`."""
        rows = self.rows(speeds)
        block = self.covariance[:, : self.p, : self.p]
        variance = np.einsum("nkp,npq,nkq->nk", rows, block, rows)
        scale = self.noise * np.sqrt(self.inflation)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)) * scale[:, None])

    def intervals(self) -> tuple[Array, Array]:
        """Return values and half-widths as parts of the torque limit, each (n, 14).

        The columns are the curve at ``SPEEDS``, Coulomb friction, and viscous at full velocity.
        """
        values, errors = self._values(SPEEDS), self.deviations()
        return values, half_widths(errors, self._information(errors), self.boundary)

    def sizes(self) -> Array:
        """Return the root mean square of each joint's curve, (n,), as a part of the limit."""
        return np.asarray(np.sqrt((self._values(SPEEDS)[:, :-2] ** 2).mean(axis=1)))

    def _information(self, errors: Array) -> Array | None:
        """Return the information expected at the stop, (n, 14), None until it is near.

        It is fixed once the widest interval of each curve takes half as much information again.
        """
        if self._expected is None:
            widest = self.boundary * errors[:, :-2].max(axis=1)
            if not (widest < NEAR * self.relative * self.sizes()).all():
                return None
            self._expected = 1.25 / errors**2
        return self._expected

    def curve(self, joint: int, velocities: Array) -> tuple[Array, Array, Array]:
        """Return friction [N m] and the ends of its intervals, each (k,), at velocities (k,)."""
        unit, x = self.limits.torque[joint], np.asarray(velocities) / self.limits.velocity[joint]
        values, errors = self._values(x)[joint, :-2], self.deviations(x)[joint, :-2]
        expected = self._information(self.deviations())
        if expected is not None:
            speeds = np.log(np.clip(np.abs(x), SPEEDS[0], SPEEDS[-1]))
            known = np.log(expected[joint, :-2])
            expected = np.exp(np.interp(speeds, np.log(SPEEDS), known))
        half = half_widths(errors, expected, self.boundary)
        return values * unit, (values - half) * unit, (values + half) * unit


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
