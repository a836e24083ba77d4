"""Families of excitation trajectories: each turns standard normal numbers into a motion in limits.

Motions begin and end at rest. Multisines and Fourier series: J. Swevers et al., "Optimal robot
excitation and identification", IEEE Trans. Robotics and Automation 13, 5 (1997). Ladders move each
joint by segments of constant speed. Splines take any shape, which is improved step by step.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from scipy.interpolate import BPoly, BSpline, CubicHermiteSpline
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array, vstack
from scipy.sparse.linalg import spsolve
from scipy.special import ndtr

from dopt.robots.body import Motion
from dopt.robots.limits import Limits
from dopt.types import Array

RAMP = 2.0
"""Most seconds in which a series begins, and in which it ends; a tenth of short ones."""

ROOM = 0.95
"""Share of the ranges of position and of the limits of rates that a motion uses."""

SLOWEST = 0.02
"""Share of the limit of velocity of a ladder's slowest segment."""

SEGMENT = 0.5
"""Seconds of a ladder's segment at the least."""

HARMONICS = 10
"""Harmonics of a Fourier series."""

KNOT, LEAST = 0.2, 12
"""Seconds between two knots of a spline, and its segments at the least."""


@dataclasses.dataclass(frozen=True)
class Family(ABC):
    """Motions of one kind.

    Parameters
    ----------
    limits : Limits
    seconds : float
        Duration [s].
    """

    limits: Limits
    seconds: float

    @property
    def n(self) -> int:
        return len(self.limits.velocity)

    @property
    @abstractmethod
    def name(self) -> str:
        """Name in tables."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Count of the numbers that a motion is made from."""

    @abstractmethod
    def motion(self, numbers: Array, dt: float, reach: float = 1.0) -> Motion:
        """Return the motion of some numbers, (size,), normally distributed in a first draw.

        Parameters
        ----------
        numbers : (size,)
        dt : float
            Time from one row to the next [s].
        reach : float
            Share of its amplitude that the motion has, for torques and collisions.
        """

    def _times(self, dt: float) -> Array:
        return dt * np.arange(max(round(self.seconds / dt), 2), dtype=float)

    def _centres(self, numbers: Array) -> Array:
        """Return the positions about which joints move, (n,): the middle third of the ranges."""
        half = ROOM * np.diff(self.limits.position, axis=1)[:, 0] / 2.0
        return self.limits.middle + half / 3.0 * np.tanh(numbers)


@dataclasses.dataclass(frozen=True)
class Fourier(Family):
    """Periodic series of :data:`HARMONICS` harmonics, about a centre.

    Parameters
    ----------
    period : float
        Longest period [s].
    """

    period: float = 10.0

    equal: ClassVar[bool] = False
    """Whether the velocities of all lines are equally large."""

    @property
    def name(self) -> str:
        return f"Fourier, {self.period:g} s"

    @property
    def rates(self) -> Array:
        """Angular frequencies, (k,) [rad/s]."""
        return 2.0 * np.pi / self.period * np.arange(1.0, HARMONICS + 1.0)

    @property
    def size(self) -> int:
        return self.n * (2 * len(self.rates) + 1)

    def motion(self, numbers: Array, dt: float, reach: float = 1.0) -> Motion:
        """Return Σ (a cos ωt + b sin ωt)/ω between ramps, as large as the limits allow."""
        rates, parts = self.rates, numbers.reshape(-1, self.n)
        centres, cosines, sines = self._centres(parts[0]), *np.split(parts[1:], 2)
        sizes = (np.hypot(cosines, sines) if self.equal else 1.0) * rates[:, None]
        t = self._times(dt)
        phase = np.outer(t, rates)
        c, s = np.cos(phase), np.sin(phase)
        a, b = cosines / sizes, sines / sizes
        shape = c @ a + s @ b
        rate = (-s * rates) @ a + (c * rates) @ b
        turn = -(c * rates**2) @ a - (s * rates**2) @ b
        w, w1, w2 = (one[:, None] for one in _ramps(t, self.seconds))
        positions = w * shape
        velocities = w1 * shape + w * rate
        accelerations = w2 * shape + 2.0 * w1 * rate + w * turn
        half = np.diff(self.limits.position, axis=1)[:, 0] / 2.0
        room = half - np.abs(centres - self.limits.middle) / ROOM
        taken = _taken(self.limits, room, positions, velocities, accelerations)
        size = reach * ROOM / np.maximum(taken, 1e-12)
        return Motion(dt, centres + size * positions, size * velocities, size * accelerations)


@dataclasses.dataclass(frozen=True)
class Multisine(Fourier):
    """Sum of sines with random phases, up to ``fastest`` Hz, whose velocities are equally large."""

    fastest: float = 2.0

    equal = True
    name = "multisine"

    @property
    def rates(self) -> Array:
        lines = max(3, int(min(self.fastest * self.seconds, 20)))
        return 2.0 * np.pi * np.linspace(1.0 / self.seconds, self.fastest, lines)


@dataclasses.dataclass(frozen=True)
class Ladder(Family):
    """Segments of constant speed for each joint, between smooth ramps.

    Numbers choose the speeds, a log-uniform draw, and the places of the start. A segment moves to
    the side that has more room, and ends where the room does.
    """

    name = "ladder"

    @property
    def segments(self) -> int:
        """Most segments of a joint."""
        return max(2, round(self.seconds / SEGMENT))

    @property
    def size(self) -> int:
        return self.n * (self.segments + 1)

    def motion(self, numbers: Array, dt: float, reach: float = 1.0) -> Motion:
        parts = numbers.reshape(self.segments + 1, self.n)
        centres = self._centres(parts[0])
        t = self._times(dt)
        columns = []
        for k in range(self.n):
            low, high = self.limits.position[k]
            middle, half = (low + high) / 2.0, reach * ROOM * (high - low) / 2.0
            path = JointPath(
                float(centres[k]),
                (middle - half, middle + half),
                ROOM * self.limits.acceleration[k],
            )
            for number in parts[1:, k]:
                share = SLOWEST ** (1.0 - ndtr(number))
                path.move(reach * ROOM * self.limits.velocity[k] * share, SEGMENT, t[-1])
            path.rest(t[-1])
            columns.append(path.sampled(t))
        q, v, a = (np.stack(parts, axis=1) for parts in zip(*columns, strict=True))
        return Motion(dt, q, v, a)


@dataclasses.dataclass(frozen=True)
class Spline(Family):
    """Cubic spline of each joint: numbers are its control points, the first and the last at rest.

    Its positions, velocities and accelerations lie between its control points and their
    differences, so that limits are linear in the numbers. Its knots are about ``knot`` apart [s].
    """

    knot: float = KNOT

    name = "spline"

    @property
    def _count(self) -> int:
        """Control points that are free: three more at either end repeat it."""
        return max(LEAST, round(self.seconds / self.knot)) - 3

    @property
    def size(self) -> int:
        return self.n * self._count

    def motion(self, numbers: Array, dt: float, reach: float = 1.0) -> Motion:
        points, middle = numbers.reshape(self._count, self.n), self.limits.middle
        q, v, a = (of @ points for of in self.basis(dt))
        return Motion(dt, middle + reach * (q - middle), reach * v, reach * a)

    def basis(self, dt: float) -> tuple[csr_array, ...]:
        """Return positions, velocities and accelerations by the control points, (T, m) each."""
        step = self.seconds / (self._count + 3)
        t, knots = self._times(dt), step * np.arange(-3.0, self._count + 7.0)
        inner = knots, knots[1:-1], knots[2:-2]
        degrees = zip(inner, (3, 2, 1), self._controls(), strict=True)
        return tuple(BSpline.design_matrix(t, one, k) @ of for one, k, of in degrees)

    def _controls(self) -> tuple[csr_array, csr_array, csr_array]:
        """Return all control points, and rates between them, (m + 6, m), (m + 5, m), (m + 4, m)."""
        rows, last = np.arange(self._count + 6), self._count - 1
        step = self.seconds / (self._count + 3)
        points: csr_array = csr_array((np.ones(len(rows)), (rows, np.clip(rows - 3, 0, last))))
        first = (points[1:] - points[:-1]) / step
        return points, first, (first[1:] - first[:-1]) / step

    def shortened(self, numbers: Array, reach: float) -> Array:
        """Return the numbers of a motion that reaches as far as some do with a share of it."""
        away = numbers.reshape(self._count, self.n) - self.limits.middle
        result: Array = self.limits.middle + reach * away
        return result.ravel()

    def nearest(self, motion: Motion) -> Array:
        """Return the numbers of a motion by least squares; joints shrink into their limits."""
        basis, *_ = self.basis(motion.dt)
        points = spsolve((basis.T @ basis).tocsc(), basis.T @ motion.positions)
        points = points.reshape(-1, self.n)
        limits, (_, first, second) = self.limits, self._controls()
        away = points - limits.middle
        room = np.ptp(limits.position, axis=1) / 2.0
        taken = _taken(limits, room, away, first @ points, second @ points)
        result: Array = limits.middle + away / np.maximum(taken / ROOM, 1.0)
        return result.ravel()

    def ascent(self, numbers: Array, slopes: Array, radius: float) -> Array:
        """Return the numbers within the limits that maximise a linear function.

        Parameters
        ----------
        numbers : (size,)
            Where it is linear.
        slopes : (m, n)
            Its derivatives by the control points.
        radius : float
            Share of its range of position by which a control point may change.
        """
        points, limits = numbers.reshape(self._count, self.n), self.limits
        found = points.copy()
        _, first, second = self._controls()
        rates, counts = vstack([first, second]), [first.shape[0], second.shape[0]]
        for k, (low, high) in enumerate(limits.position):
            half, most = ROOM * (high - low) / 2.0, radius * (high - low)
            sizes = ROOM * np.array([limits.velocity[k], limits.acceleration[k]])
            largest = np.repeat(sizes, counts)
            program = milp(  # a linear program: its rows have two sides
                -slopes[:, k],
                bounds=Bounds(
                    np.maximum(limits.middle[k] - half, points[:, k] - most),
                    np.minimum(limits.middle[k] + half, points[:, k] + most),
                ),
                constraints=LinearConstraint(rates, -largest, largest),
            )
            if program.x is not None:  # rounding alone lets none be found
                found[:, k] = program.x
        return found.ravel()


class JointPath:
    """Path of one joint at constant speeds, between ramps without jumps of the acceleration.

    Parameters
    ----------
    start : float
        Position at which it begins, at rest.
    room : tuple of float
        Least and largest position.
    acceleration : float
        Largest magnitude, in the middle of each ramp.
    """

    def __init__(self, start: float, room: tuple[float, float], acceleration: float) -> None:
        self.room, self._mean = room, acceleration / 1.5  # by a ramp v = 3 s² - 2 s³
        self.position = self._start = float(np.clip(start, *room))
        self.now = self.speed = 0.0
        self._times, self._speeds = [self.now], [self.speed]

    def _to(self, speed: float, seconds: float) -> None:
        if seconds > 1e-9:
            self.position += 0.5 * (self.speed + speed) * seconds
            self.now, self.speed = self.now + seconds, speed
            self._times.append(self.now)
            self._speeds.append(speed)

    def _way(self, speed: float) -> float:
        """Return the way from a speed to rest."""
        return speed * abs(speed) / (2.0 * self._mean)

    def move(self, magnitude: float, seconds: float, end: float) -> None:
        """Add a segment of a speed, whose sign has more room, that can still come to rest in it."""
        sign = 1.0 if sum(self.room) >= 2.0 * (self.position + self._way(self.speed)) else -1.0
        target = sign * magnitude
        ramp = abs(target - self.speed) / self._mean
        after = self.position + 0.5 * (self.speed + target) * ramp
        wall = self.room[1] if sign > 0 else self.room[0]
        left = sign * (wall - after) - self._way(magnitude)
        hold = min(seconds, left / magnitude)
        rest = end - self.now - magnitude / self._mean - ramp
        turn = self.position + self._turn(target, ramp)
        inside = self.room[0] - 1e-9 <= turn <= self.room[1] + 1e-9
        if hold <= 0.0 or rest <= 0.0 or not inside:
            self._brake(end)
            return
        self._to(target, ramp)
        self._to(target, min(hold, rest))

    def _turn(self, target: float, ramp: float) -> float:
        """Return the way to the point where a ramp to another sign turns; 0 without one."""
        if self.speed * target >= 0.0:
            return 0.0
        change = target - self.speed
        s = 0.5 - math.sin(math.asin(1.0 + 2.0 * self.speed / change) / 3.0)
        return ramp * (self.speed * s + change * (s**3 - 0.5 * s**4))

    def _brake(self, end: float) -> None:
        self._to(0.0, min(abs(self.speed) / self._mean, max(end - self.now, 0.0)))

    def rest(self, end: float) -> None:
        """Brake, and stay until the end."""
        self._brake(end)
        self._to(0.0, end - self.now)

    def sampled(self, t: Array) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations at some times, (T,) each."""
        rate = CubicHermiteSpline(self._times, self._speeds, np.zeros(len(self._times)))
        return self._start + rate.antiderivative()(t), rate(t), rate.derivative()(t)


def _taken(
    limits: Limits, room: Array, positions: Array, velocities: Array, accelerations: Array
) -> Array:
    """Return the largest shares of a room for positions and of the limits of rates, (n,)."""
    parts = positions / room, velocities / limits.velocity, accelerations / limits.acceleration
    return np.asarray(np.max([np.abs(part).max(axis=0) for part in parts], axis=0))


def _ramps(t: Array, seconds: float) -> tuple[Array, Array, Array]:
    """Return a window that rises from 0 to 1 and falls again, and its two derivatives.

    A quintic with no velocity and no acceleration at its ends.
    """
    ramp, last = min(RAMP, seconds / 10.0), t[-1]
    ends = [[height, 0.0, 0.0] for height in (0.0, 1.0, 1.0, 0.0)]
    window = BPoly.from_derivatives([0.0, ramp, last - ramp, last], ends)
    return window(t), window.derivative()(t), window.derivative(2)(t)
