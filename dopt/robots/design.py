"""Design of excitation trajectories, and the share of the attainable information that each has.

The criterion is D_s: the log determinant of the covariance of the requested parameters, in relative
units, with a prior standard deviation of 1 for every parameter; what is unknown and not requested
counts as such. A penalty keeps every error near or below its median over random multisines. The
bound is by J. Kiefer and J. Wolfowitz, "The equivalence of two extremum problems", Can. J. Math. 12
(1960): no motion has more information than the best measure over all states within the limits.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Self

import numpy as np

from dopt.arguments import whole, within
from dopt.errors import SpecificationError
from dopt.robots.body import Body, Motion
from dopt.robots.limits import Limits, check_weight
from dopt.robots.parameters import Parameter, Unknowns, count_null, relative_errors
from dopt.robots.trajectories import KNOT, ROOM, Family, Fourier, Ladder, Multisine, Spline
from dopt.types import Array

COARSE = 0.04
"""Most time between the rows of a motion while it is searched [s]."""

FINE = 0.01
"""Time between the rows of a motion whose torques and collisions are checked at the end [s]."""

REFERENCES = 25
"""Random multisines, whose median errors every design is compared with."""

PERIODS = (2.0, 5.0, 10.0, 20.0)
"""Periods of the Fourier series that are tried [s]."""

DRAWN = 24
"""Random motions of each other family."""

EFFORT = 40
"""Splines that are tried unless told otherwise."""

KNOTS = (KNOT, KNOT / 2.0, KNOT / 4.0)
"""Times between the knots of splines that are tried [s], until one is best."""

RADIUS, WIDEST, NARROWEST = 0.1, 0.3, 0.002
"""Share of the ranges of position by which a spline first changes; the most, and the least."""

STEP = 1e-4
"""Step of positions [rad or m], and share of the limits of rates, for derivatives."""

ABOVE = 1.1
"""Error by its reference above which a penalty begins."""

FLOOR = 3.0
"""Weight of the logarithm by which the worst error exceeds its reference."""

SHARP = 20.0
"""Decay of what an error counts in the slope of the penalty, by its distance to the worst one."""

LEAST = 0.1
"""Share of its scale that an unknown parameter is at the least, where torques are linearised.

Where a centre or a friction is 0, the error of the mass or gear that multiplies it does not count.
"""

FRICTION = "damping,frictionloss"
"""Unknown parameters beside the requested ones unless told otherwise."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A motion that was designed.

    Attributes
    ----------
    family : Family
    numbers : (size,)
        What :meth:`Family.motion` makes it of.
    reach : float
        Share of its amplitude, for torques and collisions.
    determinant : float
        log det of the information about the requested parameters.
    errors : (p,)
        Standard errors of the requested parameters, relative.
    broken : float
        By how much it breaks the limits of torque or lets bodies touch; 0 if it does neither.
    share : float
        Share of the attainable information about them, for each of them; 0 until it is known.
    """

    family: Family
    numbers: Array
    reach: float
    determinant: float
    errors: Array
    broken: float
    share: float = 0.0

    @property
    def name(self) -> str:
        return self.family.name

    @property
    def free(self) -> bool:
        """Whether it keeps the limits of torque and no bodies touch."""
        return self.broken == 0.0

    def motion(self, dt: float) -> Motion:
        """Return the motion with rows dt apart [s]."""
        return self.family.motion(self.numbers, dt, self.reach)


class Problem:
    """Parameters that a trajectory is to identify, and its limits.

    Parameters
    ----------
    body : Body
    limits : Limits
    wanted : str or sequence of str
        The requested parameters (:class:`dopt.robots.parameters.Unknowns`).
    seconds : float
        Duration of the motion [s].
    nuisance : str
        What is also unknown; friction of the joints unless told otherwise.
    noise : float
        Standard deviation of a measured torque, as a share of the limit.
    rate : float
        Independent measurements of the torques in a second [Hz].
    """

    def __init__(
        self,
        body: Body,
        limits: Limits,
        wanted: str | Sequence[str],
        seconds: float,
        *,
        nuisance: str = FRICTION,
        noise: float = 0.01,
        rate: float = 500.0,
    ) -> None:
        self.body, self.limits = body, limits
        check_weight(body, limits)
        self.seconds = within("seconds of a design", seconds, math.inf)
        self.step = min(COARSE, self.seconds / 50.0)
        self.rate = within("rate of a design", rate, math.inf)
        noise = within("noise of a design", noise, math.inf)
        asked = Unknowns(body, limits, wanted, noise)
        beside = [one for one in nuisance.split(",") if one]
        self.unknowns = Unknowns(body, limits, [*asked.names, *beside], noise)
        values, least = self.unknowns.values, LEAST * self.unknowns.scales
        self.tangent, _ = self.unknowns.at(np.copysign(np.maximum(abs(values), least), values))
        self.count = len(asked)
        dry, viscous = body.model.dof_frictionloss[body.dofs], body.model.dof_damping[body.dofs]
        typical = np.where(dry + viscous > 0.0, dry, 0.1 * limits.torque)
        self._friction = typical, viscous
        self.reference = np.ones(self.count)

    @property
    def requested(self) -> tuple[Parameter, ...]:
        """The requested parameters, which come first of the unknown ones."""
        return self.unknowns.parameters[: self.count]

    def information(self, motion: Motion) -> Array:
        return self.tangent.information(motion, self.rate)

    def determinant(self, information: Array) -> float:
        """Return log det of the information about the requested parameters, with the prior."""
        whole_ = information + np.eye(len(information))
        rest = whole_[self.count :, self.count :]
        return float(np.linalg.slogdet(whole_)[1] - np.linalg.slogdet(rest)[1])

    def errors(self, information: Array) -> Array:
        """Return the relative standard errors of the requested parameters, (p,)."""
        return relative_errors(information)[: self.count]

    def score(self, one: Candidate) -> float:
        """Return the mean logarithm of the relative errors, by D_s, and the penalties.

        Lower is better.
        """
        worst = math.log(float(np.max(one.errors / self.reference)) / ABOVE)
        return -0.5 * one.determinant / self.count + FLOOR * max(worst, 0.0) + 10.0 * one.broken

    def strains(self, motion: Motion, rigid: Array | None = None) -> Array:
        """Return the largest shares of the limits of torque, friction included, (n,)."""
        rates, (dry, viscous) = motion.velocities, self._friction
        friction = dry * np.tanh(rates / (0.01 * self.limits.velocity)) + viscous * rates
        shares = np.abs(self.body.torques(motion, rigid) + friction) / self.limits.torque
        return np.asarray(shares.max(axis=0))

    def candidate(self, family: Family, numbers: Array) -> Candidate:
        """Return a motion with what it tells; its share is not known yet.

        It reaches as far as the torques allow, and has a penalty where bodies touch.
        """
        reach = shorter = 1.0
        for _ in range(6):
            reach *= shorter
            motion = family.motion(numbers, self.step, reach)
            rigid = self.body.regressor(motion)
            strain = float(self.strains(motion, rigid).max())
            if strain <= ROOM:  # between these rows it may be larger
                break
            shorter = max(0.6, 0.98 * math.sqrt(ROOM / strain))
        looked = motion.positions[::3]
        touching = {row for row, _, _ in self.body.collisions(looked)}
        broken = max(strain - ROOM, 0.0)
        broken += 0.5 + len(touching) / len(looked) if touching else 0.0
        information = self.tangent.information(motion, self.rate, rigid)
        told = self.determinant(information), self.errors(information)
        return Candidate(family, numbers, reach, *told, broken)

    def obstacle(self, one: Candidate) -> str:
        """Return which torque is too large or which bodies touch at finer steps; "" if none do."""
        motion, body = one.motion(min(FINE, self.step)), self.body
        strains = self.strains(motion)
        if strains.max() > 1.0:
            k, limit = int(strains.argmax()), self.limits.torque
            taken = f"{strains[k] * limit[k]:.3g} of {limit[k]:g} {body.units[k]}"
            return f"joint '{body.joints[k]}' takes {taken}"
        touching = body.collisions(motion.positions)
        return f"the bodies {touching[0][1]} and {touching[0][2]} touch" if touching else ""

    def checked(self, one: Candidate) -> Candidate:
        """Return a candidate, broken only if something stands against it at finer steps."""
        return dataclasses.replace(one, broken=float(bool(self.obstacle(one))))


@dataclasses.dataclass(frozen=True)
class Design:
    """The candidates of a problem, best first.

    Attributes
    ----------
    problem : Problem
    candidates : tuple of Candidate
    reference : (p,)
        Median relative errors of random multisines.
    gap : float
        Share of the attainable information by which its bound may be too low.
    """

    problem: Problem
    candidates: tuple[Candidate, ...]
    reference: Array
    gap: float

    @property
    def best(self) -> Candidate:
        return self.candidates[0]

    @classmethod
    def of(
        cls,
        problem: Problem,
        *,
        seed: int = 0,
        effort: int = EFFORT,
        progress: Callable[[str], object] = lambda _: None,
    ) -> Self:
        """Draw motions of each family, improve the best, and compare them.

        Parameters
        ----------
        problem : Problem
        seed : int
            Seed of the draws.
        effort : int
            Splines that are tried, from the best motion of the other families.
        progress : callable, optional
            Is given a line for each family.
        """
        seed = whole("seed", seed, 0, 2**63)
        effort = whole("effort", effort, 1, 10**7)
        rng = np.random.default_rng(seed)
        drawn = list(map(problem.checked, _drawn(problem, rng, progress)))

        def order(one: Candidate) -> tuple[bool, float]:
            return not one.free, problem.score(one)

        begun = min(drawn, key=order)
        last = problem.checked(improved(problem, begun, effort, progress))
        found = sorted([*drawn, last], key=order)
        if not found[0].free:
            raise SpecificationError(
                f"no motion was found within the limits of torque and without collisions (in the "
                f"best one, {problem.obstacle(found[0])}): give smaller ranges of position around "
                f"a pose in which the robot is free, or larger torques."
            )
        bound, gap = attainable(problem, rng)
        null = count_null(problem.tangent, drawn[0].motion(problem.step))
        identified = max(problem.count - null, 1)
        shared = [
            dataclasses.replace(one, share=math.exp((one.determinant - bound) / identified))
            for one in found
        ]
        return cls(problem, tuple(shared), problem.reference, gap / identified)


def _drawn(
    problem: Problem, rng: np.random.Generator, progress: Callable[[str], object]
) -> Iterator[Candidate]:
    """Yield the best random motion of each family."""
    limits, seconds = problem.limits, problem.seconds
    best = multisine(problem, rng)
    progress(f"multisine, best of {REFERENCES}: {_said(best)}")
    yield best
    periods = [period for period in PERIODS if period < seconds]
    series = [Fourier(limits, seconds, period) for period in [*periods, seconds]]
    for family in (*series, Ladder(limits, seconds)):
        drawn = (problem.candidate(family, rng.standard_normal(family.size)) for _ in range(DRAWN))
        best = min(drawn, key=problem.score)
        progress(f"{family.name}, best of {DRAWN}: {_said(best)}")
        yield best


def multisine(problem: Problem, rng: np.random.Generator) -> Candidate:
    """Return the best of some random multisines, whose median errors become the reference."""
    family = Multisine(problem.limits, problem.seconds)
    drawn = [problem.candidate(family, rng.standard_normal(family.size)) for _ in range(REFERENCES)]
    problem.reference = np.median([one.errors for one in drawn], axis=0)
    return min(drawn, key=problem.score)


def _said(one: Candidate) -> str:
    return (
        f"geometric mean of the relative errors {100.0 * math.exp(np.log(one.errors).mean()):.3g} %"
    )


def improved(
    problem: Problem,
    begun: Candidate,
    effort: int,
    progress: Callable[[str], object] = lambda _: None,
) -> Candidate:
    """Return the best spline of some, which begin near a motion.

    Knots come closer until a spline is better than the motion that it begins from: one with few
    knots cannot follow fast lines.
    """
    found: list[Candidate] = []
    for knot in KNOTS:
        spline = Spline(problem.limits, problem.seconds, knot)
        found.append(_ascended(problem, spline, begun, effort))
        progress(f"{spline.name}, from {begun.name}, {knot:g} s between knots: {_said(found[-1])}")
        if problem.score(found[-1]) < problem.score(begun):
            break
    return min(found, key=problem.score)


def _ascended(problem: Problem, spline: Spline, begun: Candidate, effort: int) -> Candidate:
    """Return the best of ``effort`` splines, the first of them near a motion.

    Each next one maximises the linearised criterion near the best: successive linear programs, R.
    E. Griffith and R. A. Stewart, Management Science 7, 4 (1961). It is kept where it is better and
    nothing stands against it.
    """
    basis = spline.basis(problem.step)
    best = problem.candidate(spline, spline.nearest(begun.motion(problem.step)))
    radius, slopes = RADIUS, None
    for _ in range(effort):
        if slopes is None:
            points = spline.shortened(best.numbers, best.reach)
            parts = zip(basis, gradient(problem, best.motion(problem.step)), strict=True)
            slopes = np.sum([of.T @ by for of, by in parts], axis=0)
        one = problem.candidate(spline, spline.ascent(points, slopes, radius))
        if problem.score(one) < problem.score(best) and not problem.obstacle(one):
            best, slopes, radius = one, None, min(1.5 * radius, WIDEST)
        elif (radius := 0.4 * radius) < NARROWEST:
            break
    return best


def gradient(problem: Problem, motion: Motion) -> list[Array]:
    """Return slopes that lower the score by positions, velocities, accelerations, (T, n) each.

    Their penalty is smooth, and begins where an error exceeds its reference.
    """
    unknowns, rate, n = problem.tangent, problem.rate, problem.body.n
    rows = unknowns.weighted(motion, rate)
    flat = rows.reshape(-1, len(unknowns))
    information = flat.T @ flat
    errors = problem.errors(information)
    information += np.eye(len(unknowns))
    weights = 0.5 / problem.count * _by_information(information, problem.count)
    above = np.log(errors / problem.reference)
    if above.max() > 0.0:
        columns = np.linalg.inv(information)[:, : problem.count] / errors
        shares = np.exp(SHARP * (above - above.max()))
        weights += 0.5 * FLOOR / shares.sum() * (columns * shares) @ columns.T
    now, found = _values(rows, weights), []
    parts = [motion.positions, motion.velocities, motion.accelerations]
    scales = [np.ones(n), problem.limits.velocity, problem.limits.acceleration]
    for i, scale in enumerate(scales):
        moved = [np.tile(part, (n, 1)) for part in parts]
        step = STEP * np.repeat(np.diag(scale), len(now), axis=0)
        moved[i] += step
        values = _values(unknowns.weighted(Motion(motion.dt, *moved), rate), weights)
        found.append((values.reshape(n, -1) - now).T / (STEP * scale))
    return found


POOL, ROUNDS = 1500, 60
"""States of the measure that bounds the information, and rounds of its improvement."""


def attainable(problem: Problem, rng: np.random.Generator) -> tuple[float, float]:
    """Return a bound of log det of the information about the requested parameters, and its gap.

    The measure over states within the limits is improved by the multiplicative algorithm; then the
    theorem bounds what any other measure over the same states could add. The states are drawn, half
    of their velocities and accelerations at the limits.

    Returns
    -------
    bound, gap : float
        The bound holds the gap.
    """
    states = _states(problem, rng)
    rows = problem.tangent.weighted(states, problem.rate * problem.seconds / states.dt)
    p, s = len(problem.unknowns), problem.count
    weights = np.full(len(rows), 1.0 / len(rows))
    flat = rows.reshape(-1, p)
    for _ in range(ROUNDS + 1):
        information = flat.T @ (flat * np.repeat(weights, rows.shape[1])[:, None])
        slopes = _values(rows, _by_information(information + np.eye(p), s))
        mean, gap = float(weights @ slopes), float(slopes.max() - weights @ slopes)
        weights = weights * np.sqrt(np.maximum(slopes, 0.0) / mean)
        weights /= weights.sum()
    return problem.determinant(information) + gap, gap


def _by_information(information: Array, s: int) -> Array:
    """Return the derivative of D_s by the information, (p, p)."""
    inverse = np.array(np.linalg.inv(information), dtype=float)
    inverse[s:, s:] -= np.linalg.inv(information[s:, s:])
    return inverse


def _values(rows: Array, weights: Array) -> Array:
    """Return the weight of what each state tells, (N,), of its rows, (N, n, p)."""
    return np.asarray(np.einsum("tjp,tjp->t", rows @ weights, rows))


def _states(problem: Problem, rng: np.random.Generator) -> Motion:
    """Return states within the limits, also of torque, as the rows of a motion."""
    limits, n = problem.limits, problem.body.n
    half = np.diff(limits.position, axis=1)[:, 0] / 2.0
    q = limits.middle + half * rng.uniform(-1.0, 1.0, (2 * POOL, n))
    v, a = (
        np.where(
            rng.random((2 * POOL, n)) < 0.5,
            rng.choice([-1.0, 1.0], (2 * POOL, n)),
            np.sign(rng.standard_normal((2 * POOL, n))) * rng.random((2 * POOL, n)) ** 3,
        )
        * limit
        for limit in (limits.velocity, limits.acceleration)
    )
    torques = np.abs(problem.body.torques(Motion(1.0, q, v, a)) / limits.torque).max(axis=1)
    a /= np.maximum(1.0, torques**2)[:, None]  # towards the torques of rest
    strains = np.abs(problem.body.torques(Motion(1.0, q, v, a)) / limits.torque).max(axis=1)
    kept = np.flatnonzero(strains <= 1.0)[:POOL]
    if not kept.size:
        raise SpecificationError(
            f"the limits of torque hold the robot in none of {2 * POOL} poses that were drawn from "
            f"its ranges of position: give smaller ranges, or larger torques."
        )
    return Motion(1.0, q[kept], v[kept], a[kept])
