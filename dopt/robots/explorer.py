"""Exploration of a robot whose body is known: it moves, learns friction, and stops when told."""

from __future__ import annotations

import copy
import logging
import math
import time as clock
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from dopt import arguments
from dopt.errors import ExplorationError, SpecificationError, unknown_name
from dopt.robots.body import Body, KnownBody, Motion, hang, listed, point
from dopt.robots.friction import RIPPLE, SPEEDS, CoulombViscous, FrictionLearner, window_size
from dopt.robots.limits import Limits
from dopt.robots.tracking import Guard, Tracker, possible_acceleration
from dopt.sphere import sphere_maximizer
from dopt.types import Array

LEVELS = np.array([0.022, 0.035, 0.06, 0.12, 0.25, 0.5, 0.93])
"""Speeds of segments, as parts of the velocity limit."""

HOLDS = np.array([1.5, 4.0, 10.0, 25.0])
"""Windows for which a segment keeps its speed, at most."""

USED = 0.9
"""Part of the acceleration limit that references take: the rest is for tracking."""

EDGE = 0.02
"""Part of a joint's range at each end where references do not go."""

GUARDED = 0.9
"""Part of the velocity limit from which torques brake."""

SURGE, AHEAD, FADED = 0.04, 3.0, 4.0
"""Room for rates that run ahead of references.

First by a period of this part of the torque limit, then by what was seen, which fades in so many
seconds; it counts so many times.
"""

SLIP = 0.02, 0.2
"""Parts of the velocity limit by which a joint that breaks loose is ahead of its reference.

From the first on, a part of the error that pushed it is forgotten, at the second the whole.
"""

STILL = 10.0
"""Seconds after which joints that have not moved are named."""

CREEP = 0.1
"""Part of the velocity limit that references may always take."""

FALSE_ALARM = 1e-8
"""Probability that an unchanged robot looks changed in a window."""

RECENT = 10
"""Windows whose innovations are compared with their intervals, and, from the 30th, are enough."""

LIFTED = 2.0
"""Seconds from which a payload is estimated, at least 20 windows."""

UNTOLD = 0.2
"""Standard error of a payload's mass, as a part of it, from which it is said to be unsure."""

LOST = 50
"""Measurements in turn that make no sense, after which the next is believed."""

AWAY = 1.0
"""Seconds for which references lead away from a contact that torques came near."""

STEP = 1e-6
"""Step of rates, as parts of the velocity limit, for the derivative of J."""

INPUTS = ("references", "torques")

_log = logging.getLogger("dopt.robots")


class RobotExplorer:
    """Robot that chooses what it moves next by what that teaches of its friction.

    Ask for torques and tell what was measured, once a period of control:

        explorer = RobotExplorer("arm.xml", limits, stop={"curve": 0.05})
        while not explorer.done:
            torque = explorer.ask(q)
            q = measured_after(torque)
            explorer.tell(q, torque)

    With ``inputs="references"``, each joint moves with constant speeds and bounded accelerations,
    tracked by computed torque with the friction learned so far. The next speed of a joint is the
    one that narrows the widest intervals of its friction curve most a second; ripple is a
    nuisance.
    With ``inputs="torques"``, the torques of each period are the paper's D-optimal step.
    All joints brake before contacts of bodies that do not touch at home, and are then led away.

    Parameters
    ----------
    body : Body or path of an MJCF or URDF file
    limits : Limits
    friction : str
        "coulomb_viscous", or "network" with 22 parameters a joint.
    inputs : str
        "references" or "torques".
    dt : float
        Period of control [s].
    stop : mapping of str to float
        Half-widths of intervals, relative to the curve's root mean square, at which to stop, of the
        ``curve``, ``coulomb`` and ``viscous``. Without any, the robot explores for ever.
    deadline : float, optional
        Seconds that :meth:`ask` may plan; a joint whose plan is not ready brakes meanwhile.
    gamma : float
        Radius of the ball ‖u/limit‖ ≤ γ of torques.
    seed : int

    Attributes
    ----------
    payload : (4,) and (4, 4), or None
        Mass [kg] and first moment [kg m] that the last body carries since the torques changed last,
        and their covariance.

    Raises
    ------
    SpecificationError
        If an argument has another form or value.
    """

    def __init__(
        self,
        body: Body | str | Path,
        limits: Limits,
        *,
        friction: str = "coulomb_viscous",
        inputs: str = "references",
        dt: float = 0.002,
        stop: Mapping[str, float] | None = None,
        deadline: float | None = None,
        gamma: float = 0.3,
        seed: int = 0,
    ) -> None:
        self.body = body if isinstance(body, Body) else Body.load(body)
        arguments.instance("limits", limits, Limits, "Limits of the joints")
        if len(limits.torque) != self.body.n:
            raise SpecificationError(
                f"limits of {len(limits.torque)} joints were given, but the robot drives "
                f"{self.body.n}: give the limits of {', '.join(self.body.joints)}."
            )
        if inputs not in INPUTS:
            raise unknown_name("inputs", inputs, INPUTS)
        self.limits, self.inputs = limits, inputs
        self.stop = {
            name: arguments.within(f"stop.{name}", h, 1.0) for name, h in (stop or {}).items()
        }
        for name in self.stop:
            if name not in ("curve", "coulomb", "viscous"):
                raise unknown_name("what stops", name, ("curve", "coulomb", "viscous"))
        self.dt = arguments.within("dt", dt, 0.1)
        self._deadline = (
            math.inf if deadline is None else arguments.within("deadline", deadline, math.inf)
        )
        self._gamma = arguments.within("gamma", gamma, math.inf)
        self.known = KnownBody(self.body)
        possible, inertia = possible_acceleration(self.known, limits)
        self.acceleration = USED * possible
        self._guard = Guard(self.body, limits, self.acceleration)
        self.learner = FrictionLearner(
            limits,
            self.known.inverse,
            friction,
            self.dt,
            relative=min(self.stop.values(), default=0.05),
            seed=seed,
            window=window_size(inertia, limits, self.dt),
        )
        self._tracker = Tracker(self.known, limits, self.learner.feedforward, self.dt)
        edge = EDGE * np.ptp(limits.position, axis=1)
        self._low, self._high = limits.position[:, 0] + edge, limits.position[:, 1] - edge
        n = self.body.n
        self._q, self._v, self._a, self._target, self._hold, self._measured = np.zeros((6, n))
        self._ahead, self._fastest = np.zeros(n), limits.velocity
        self._wary, self._away = np.zeros(n, dtype=bool), 0.0  # since a contact was near
        self.counts = {"bad": 0, "late": 0, "near": 0, "plans": 0, "windows": 0, "changed": 0}
        self.warnings: list[str] = []
        self.steps, self._wrong, self._asked = 0, 0, False
        self._rows: list[tuple[Array, ...]] = []
        self._recent: deque[tuple[Any, ...]] = deque(maxlen=RECENT)
        self.payload: tuple[Array, Array] | None = None
        self._lifted: list[tuple[Any, ...]] | None = None
        self._since = 0  # windows since the body was last known to change
        self._done = False
        self._due: float | None = None
        self._alarm = float(chi2.isf(FALSE_ALARM, n))
        if inputs == "torques":
            self._tie = np.random.default_rng(seed).standard_normal(n)
            self._maximize = _compiled_maximizer(n)

    @property
    def done(self) -> bool:
        """Whether all intervals asked for are as narrow as asked for."""
        return self._done

    def ask(self, q: npt.ArrayLike, time: float | None = None) -> Array:
        """Return the torques [N m], (n,), of the next period, at measured positions, (n,).

        Positions that are not finite, or farther away than the joint can have moved, are replaced
        by those expected; the robot brakes meanwhile.

        Parameters
        ----------
        time : float, optional
            When they were measured [s]; a gap ends the window of samples.
        """
        began = clock.perf_counter()
        measured = arguments.numbers("q", q, self.body.n)
        if self.steps == 0 and not self._asked:
            self._begin(measured)
        self._check_time(time)
        trusted = self._observe(measured)
        self._away -= self.dt
        leads = self.inputs == "references" or self._away > 0.0 or not trusted or self._done
        torque = None if leads else self._torques()
        if torque is None:
            self._advance(trusted, began + self._deadline)
            torque = self._tracker.torque(self._q, self._v, self._a)
        self._asked, self._torque = True, torque
        return torque

    def tell(
        self, q_next: npt.ArrayLike, applied: npt.ArrayLike | None = None, time: float | None = None
    ) -> None:
        """Learn from a period: the positions after it, (n,), and the torques applied in it, (n,).

        Without ``applied``, the torques asked for were applied.

        Raises
        ------
        ExplorationError
            If no torques were asked for.
        """
        if not self._asked:
            raise ExplorationError("tell was called before ask, but each follows one: ask first.")
        after = arguments.numbers("q_next", q_next, self.body.n)
        torque = self._torque
        if applied is not None:
            torque = arguments.numbers("applied", applied, self.body.n)
        self._asked = False
        self._due = None if self._due is None else self._due + self.dt
        self._check_time(time)
        self.steps += 1
        if self._wrong or not np.isfinite(torque).all():
            self._rows.clear()
            return
        self._rows.append((self._measured, torque, self._v))
        if len(self._rows) == self.learner.window.size:
            if self._sensible(after, self._tracker.q + self.dt * self._tracker.v):
                self._learn(after)
            self._rows.clear()

    def _begin(self, measured: Array) -> None:
        if not np.isfinite(measured).all():
            raise ExplorationError(
                f"the first positions are {measured.tolist()}, but finite ones are expected: begin "
                f"when the encoders are ready."
            )
        self._tracker.place(measured)
        self._q = measured.copy()
        self.known.inverse(measured, self._v, self._v)
        surge = SURGE * self.dt * self.limits.torque / self.known.apparent_inertia()
        self._ahead = surge / self.limits.velocity
        slow = np.flatnonzero(AHEAD * self._ahead > 1.0 - CREEP)
        if light := [self.body.joints[j] for j in slow]:
            self._say(
                f"within {1e3 * self.dt:g} ms, {100.0 * SURGE:g} % of the limit of torque turns "
                f"{listed(light)} so fast that references begin with {100.0 * CREEP:g} % of the "
                f"limit of velocity: give the armature in the robot's file"
            )

    def _check_time(self, time: float | None) -> None:
        """End the window of samples where the time is not the one that is expected."""
        now = arguments.seconds(time)
        if now is not None and abs(now - (now if self._due is None else self._due)) > 0.5 * self.dt:
            self.counts["late"] += 1
            self._rows.clear()
        self._due = self._due if now is None else now

    def _sensible(self, measured: Array, expected: Array) -> bool:
        room = 4.0 * self.dt * self.limits.velocity + 0.001 * np.ptp(self.limits.position, axis=1)
        return bool((np.abs(measured - expected) <= room).all())  # false for NaN

    def _observe(self, measured: Array) -> bool:
        """Correct the observed state; return False while measurements make no sense."""
        tracker = self._tracker
        if self.steps:
            tracker.predict(self._a)
        if self._sensible(measured, tracker.q):
            self._wrong = 0
            tracker.correct(measured)
            self._measured = measured
            return True
        self.counts["bad"] += 1
        self._wrong += 1
        if self._wrong > LOST and np.isfinite(measured).all():
            tracker.place(measured)
            self._q, self._v = measured.copy(), np.zeros(self.body.n)
        return False

    # References: each joint keeps a speed for a while.

    def _advance(self, trusted: bool, until: float) -> None:
        """Move the references by a period, with new segments where one has ended."""
        self._pace()
        if trusted and not self._done:
            for j in np.flatnonzero(self._hold <= 0.0):
                if clock.perf_counter() > until:
                    self.counts["late"] += 1
                    self._target[j] = 0.0
                else:
                    self._target[j], self._hold[j] = self._segment(int(j))
                    self.counts["plans"] += 1
        else:
            self._target[:], self._hold[:] = 0.0, 0.0
        most, target = self.acceleration, np.clip(self._target, -self._fastest, self._fastest)
        a = np.clip((target - self._v) / self.dt, -most, most)
        v = self._v + a * self.dt
        blocked = self._outward(self._q + v * self.dt, v)
        brake = np.clip(-self._v / self.dt, -most, most)
        a = np.where(blocked, brake, a)
        v = self._v + a * self.dt
        if not self._guard.free(self._q + self.dt * v, v, self._q):
            a, v = brake, self._v + brake * self.dt
            self._rest()
        self._a, self._v, self._q = a, v, self._q + self.dt * v
        reached = np.abs(self._v - target) < 1e-9
        ended = blocked & ~self._wary
        self._hold = np.where(ended, 0.0, self._hold - self.dt * reached)

    def _outward(self, q: Array, v: Array) -> npt.NDArray[np.bool_]:
        """Return which joints, (n,), braking from now, come to rest beyond where they may go."""
        rest = q + v * np.abs(v) / (2.0 * self.acceleration)
        above, below = (rest > self._high) & (v > 0.0), (rest < self._low) & (v < 0.0)
        return np.asarray(above | below)

    def _pace(self) -> None:
        """Leave room between references and limits of velocity for rates that run ahead."""
        ahead = (np.abs(self._tracker.v) - np.abs(self._v)) / self.limits.velocity
        error = self._q - self._tracker.q
        forgotten = np.clip((ahead - SLIP[0]) / (SLIP[1] - SLIP[0]), 0.0, 1.0)
        self._q = self._q - np.where(error * self._tracker.v > 0.0, forgotten * error, 0.0)
        self._ahead = np.maximum(ahead, self._ahead * math.exp(-self.dt / FADED))
        self._fastest = self.limits.velocity * np.maximum(1.0 - AHEAD * self._ahead, CREEP)

    def _rest(self) -> None:
        """Brake all joints; the next motion is planned when the last one is at rest."""
        self.counts["near"] += 1
        stop = np.abs(self._v) / self.acceleration
        self._target[:], self._wary[:] = 0.0, True
        self._hold = stop.max() - stop + self.dt * np.arange(1, len(stop) + 1)

    def _segment(self, j: int) -> tuple[float, float]:
        """Return the speed and the time for which joint j keeps it with the largest gain a second.

        A segment is one equation: the mean of its features, with the noise of its windows.
        """
        learner, most, p = self.learner, self.acceleration[j], self.learner.p
        levels = np.minimum(LEVELS, self._fastest[j] / self.limits.velocity[j])
        speeds = np.repeat(np.concatenate([levels, -levels]), len(HOLDS))
        u = speeds * self.limits.velocity[j]
        hold = np.tile(HOLDS * learner.window.seconds, 2 * len(LEVELS))
        least = hold[0]
        rising = np.abs(u - self._v[j]) / most
        start = self._q[j] + 0.5 * (u + self._v[j]) * rising
        end = np.where(u > 0.0, self._high[j], self._low[j])
        room = (end - start - u * np.abs(u) / (2.0 * most)) / u
        hold = np.minimum(hold, room)
        fits = hold >= least
        if self._wary[j]:
            fits &= np.where(u < 0.0, *self._guard.open(self._q, j))
        if not fits.any():
            return 0.0, float(self._wary[j] * least)
        self._wary[j] = False
        speeds, start, hold, rising = speeds[fits], start[fits], hold[fits], rising[fits]
        rows = learner.model.jacobian(learner.mean[j : j + 1, :p], speeds[None])[0]
        features = _mean_features(start, start + u[fits] * hold)
        X = np.concatenate([rows, features], axis=1)
        covariance = learner.covariance[j]
        spread = X @ covariance
        windows = np.maximum(hold / learner.window.seconds - 0.5, 0.5)
        variance = 1.0 / windows + (X * spread).sum(axis=1)
        # Variances of the curve, and what the segment takes from them; the widest count most.
        curve = learner.rows(SPEEDS)[j, :-2]
        before = ((curve @ covariance[:p, :p]) * curve).sum(axis=1)
        taken = (spread[:, :p] @ curve.T) ** 2 / variance[:, None]
        shares = taken @ before**3 / (before**4).sum()
        gains = -np.log1p(-np.minimum(shares, 1.0 - 1e-12)) / (rising + hold)
        best = int(gains.argmax())
        return float(u[fits][best]), float(hold[best])

    # Torques: the paper's step.

    def _torques(self) -> Array | None:
        """Return torques on the ball that maximise the linearised gain; None before a contact.

        The state moves q̇ first: with δ = dt M⁻¹ u the gain Σ_j (J_j + δ_j ∂J_j)ᵀ P_j (·) is
        quadratic, with Q = dt² M⁻ᵀ diag(∂JᵀP∂J) M⁻¹ and v = -dt M⁻ᵀ (JᵀP∂J).
        """
        learner, tracker, limits = self.learner, self._tracker, self.limits
        n, p = self.body.n, learner.p
        bias = self.known.inverse(tracker.q, tracker.v, np.zeros(n))
        mass = self.known.mass_matrix()
        inverse = np.linalg.inv(mass)
        friction = learner.torques(tracker.v)
        idle = inverse @ (-bias - friction)
        x = ((tracker.v + self.dt * idle) / limits.velocity)[:, None]
        parameters = learner.mean[:, :p]
        near = x + STEP * np.array([-1.0, 0.0, 1.0])
        before, J, behind = np.moveaxis(learner.model.jacobian(parameters, near), 1, 0)
        bent = (behind - before) / (2.0 * STEP * limits.velocity[:, None])
        weighed = (learner.covariance[:, :p, :p] @ bent[..., None])[..., 0]
        D = self.dt * inverse * limits.torque
        Q = D.T @ ((bent * weighed).sum(axis=1)[:, None] * D)
        v = -D.T @ (J * weighed).sum(axis=1)
        chosen = self._maximize(Q, v, self._gamma, self._tie)
        a = idle + inverse @ (chosen * limits.torque)
        after = tracker.v + self.dt * a
        fast = np.abs(after) > GUARDED * limits.velocity
        guarded = fast | self._outward(tracker.q, after)
        if guarded.any():
            brake = np.clip(-tracker.v / self.dt, -self.acceleration, self.acceleration)
            a = np.where(guarded, brake, a)
        self._a = a
        self._q, self._v = tracker.q.copy(), tracker.v.copy()
        after = tracker.v + self.dt * a
        if not self._guard.free(tracker.q + self.dt * after, after, tracker.q):
            self._rest()
            self._away = AWAY
            return None
        demand = mass @ self._a + bias + friction
        return np.minimum(np.maximum(demand, -limits.torque), limits.torque)

    # What a window teaches.

    def _learn(self, after: Array) -> None:
        positions = np.array([*(row[0] for row in self._rows), after])
        torques = np.array([*(row[1] for row in self._rows), np.zeros(self.body.n)])
        rates = np.array([row[2] for row in self._rows]) if self.inputs == "references" else None
        means = self.learner.window.means(positions, torques)
        self.counts["windows"] += 1
        still = [self.body.joints[j] for j in np.flatnonzero(self.learner.windows == 0)]
        if still and self.counts["windows"] == math.ceil(STILL / self.learner.window.seconds):
            self._say(
                f"{listed(still)} did not move fast enough to learn from in {STILL:g} s: give the "
                f"armature in the robot's file, or look whether something holds it"
            )
        if self._lifted is not None:
            self._lifted.append((means, rates))
            if len(self._lifted) >= max(2 * RECENT, LIFTED / self.learner.window.seconds):
                self._lift(self._lifted)
            return
        before, kept = self.learner.feedforward(self._v), copy.copy(self.learner)
        standard = self.learner.learn(means, rates)
        wide = np.sqrt(self.learner.inflation)
        self._recent.append((standard / wide, self.learner.unit * wide, means, kept))
        if changed := self._changed():  # what was compared has taught of the payload, too
            self.learner.restore(self._recent[0][3])
        self._q = self._q - self._tracker.lag(self.learner.feedforward(self._v) - before)
        if changed:
            self.counts["changed"] += 1
            self._say(
                f"after {self.steps * self.dt:.2f} s the torques no longer fit the body and the "
                f"friction learned: a payload is estimated, and friction learned again"
            )
            self._lifted = []
            self._done = False
        elif self.stop and self.counts["windows"] % 5 == 0:
            self._done = self._reached()

    def _changed(self) -> bool:
        """Compare the means of recent innovations with a χ² of one degree a joint.

        Torques turn joints round within windows, which then fit badly: they are not compared.
        """
        self._since += 1
        few = len(self._recent) < RECENT or self._since < 3 * RECENT
        if few or self.inputs == "torques":
            return False
        standard, unit = (np.array([row[i] for row in self._recent]) for i in range(2))
        known = np.isfinite(standard)
        size = np.sqrt(np.maximum(known.sum(axis=0), 1))
        sums = np.where(known, standard, 0.0).sum(axis=0) / size
        if self.payload is None or sums @ sums <= self._alarm:
            return bool(sums @ sums > self._alarm)
        # What a payload that was weighed may weigh more or less is no change.
        rows = self._carried([row[2] for row in self._recent])[..., :4]
        rows = rows * (known / unit)[..., None]
        rows = rows.sum(axis=0) / size[:, None]
        spread = np.eye(len(sums)) + rows @ self.payload[1] @ rows.T
        return bool(sums @ np.linalg.solve(spread, sums) > self._alarm)

    def _led(self, means: tuple[Array, ...], rates: Array) -> tuple[Array, ...]:
        """Return position, rate and acceleration as references give them: free of noise."""
        way = self.dt * np.cumsum(np.vstack([0.0 * rates[:1], rates]), axis=0)
        return means[0], *self.learner.window.means(way, way)[1:3]

    def _carried(self, windows: list[tuple[Array, ...]]) -> Array:
        """Return torques by what is added to the last body, (k, n, 10), parts of limits."""
        q, v, a = (np.array([means[i] for means in windows]) for i in range(3))
        rows = self.body.regressor(Motion(self.learner.window.seconds, q, v, a))[..., -10:]
        return rows / self.limits.torque[:, None]

    def _lift(self, windows: list[tuple[Any, ...]]) -> None:
        """Estimate mass and centre of what the last body carries, and add them to it.

        By least squares for a point mass, with friction and ripple as unsure as they are. Rows of
        references are the instruments: noise of torques accelerates, and would look like less mass.
        """
        learner, stacks = self.learner, []
        pairs = zip(*(learner.innovations(*window)[:2] for window in windows), strict=True)
        missing, friction = map(np.array, pairs)
        rows = self._carried([means for means, _ in windows])
        led = self._carried([self._led(*window) for window in windows])[..., :4]
        for j, unit in enumerate(learner.noise):
            seen = np.isfinite(missing[:, j])
            H = friction[seen, j]
            root = np.linalg.cholesky(np.eye(len(H)) + H @ learner.covariance[j] @ H.T)
            parts = np.column_stack([missing[seen, j], led[seen, j], rows[seen, j]]) / unit
            stacks.append(np.linalg.solve(root, parts))
        wanted, led, near, turned = np.split(np.concatenate(stacks), [1, 5, 9], axis=1)
        prior = np.eye(4) / self.body.model.body_mass.sum() ** 2
        inverse = np.linalg.inv(led.T @ near + prior)
        unsure = inverse @ (led.T @ led + prior) @ inverse.T
        error, model, last = math.sqrt(unsure[0, 0]), self.known.model, self.body.moved[-1]
        load = np.zeros(10)
        for _ in range(3):  # its inertia follows from its mass and moment
            mass, *moment = inverse @ led.T @ (wanted[:, 0] - turned @ load[4:])
            own, now = self.body.model.body_mass[last], model.body_mass[last]
            mass = max(float(mass), float(0.1 * own - now))
            load = point(mass, np.array(moment), error)
        hang(model, last, load)
        learner.forget(10.0)
        hardly = ", which these motions hardly tell from its lever and from friction"
        self._say(
            f"the last body carries {mass:+.3f} kg more (standard error {error:.2g} kg"
            f"{hardly * (error > UNTOLD * abs(mass))}), whose first moment is "
            f"{load[1:4].round(3)} kg m"
        )
        self._recent.clear()
        self.payload, self._lifted, self._since = (load[:4], unsure), None, 2 * RECENT

    def _say(self, text: str) -> None:
        self.warnings.append(text)
        _log.warning(text)

    def _reached(self) -> bool:
        half, sizes = self.learner.intervals()[1], self.learner.sizes()
        widths = {"curve": half[:, :-2].max(axis=1), "coulomb": half[:, -2], "viscous": half[:, -1]}
        return all(bool((widths[name] <= h * sizes).all()) for name, h in self.stop.items())

    def curve(self, joint: int, velocities: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """Return friction [N m] of a joint and the ends of its intervals, at velocities (k,)."""
        x = arguments.reals("velocities", velocities)
        return self.learner.curve(joint, x)

    def report(self) -> dict[str, Any]:
        """Return what is known: constants with half-widths [N m; N m s], widths, counts, warnings.

        Heights of Stribeck friction are biased: it is fastest where joints turn round.
        """
        learner, unit, velocity = self.learner, self.limits.torque, self.limits.velocity
        values, half = (part * unit[:, None] for part in learner.intervals())
        with np.errstate(divide="ignore"):  # of a joint that did not move
            widths = half[:, :-2].max(axis=1) / (learner.sizes() * unit)
        joints: dict[str, dict[str, Any]] = {
            name: {
                "coulomb": (float(values[j, -2]), float(half[j, -2])),
                "viscous": (float(values[j, -1] / velocity[j]), float(half[j, -1] / velocity[j])),
                "relative_width": float(widths[j]),
                "noise": float(learner.noise[j] * unit[j]),
            }
            for j, name in enumerate(self.body.joints)
        }
        if isinstance(learner.model, CoulombViscous):
            for j, name in enumerate(self.body.joints):
                joints[name]["stribeck_biased"] = learner.mean[j, 2 : learner.p] * unit[j]
        done = {"seconds": self.steps * self.dt, "done": self._done, "joints": joints}
        return done | {"counts": dict(self.counts), "warnings": list(self.warnings)}


def _on_sphere(Q: Array, v: Array, radius: float, tie: Array) -> Array:
    return sphere_maximizer(Q, v, radius, tie)


def _compiled_maximizer(n: int) -> Callable[..., Array]:
    """Return the maximiser of :mod:`dopt.sphere`, compiled before the first period of control."""
    import dopt.kernel.policies  # noqa: F401  # it lets the maximiser compile
    from dopt.kernel.compiler import called_from_python  # Numba: references do without

    maximize = called_from_python(_on_sphere)
    maximize(np.eye(n), np.ones(n), 1.0, np.ones(n))
    return maximize


def _mean_features(start: Array, end: Array) -> Array:
    """Return the means of the features of ripple between positions, each (k,), (k, 62)."""
    a, b = start[:, None] * RIPPLE, end[:, None] * RIPPLE
    cosines, sines = np.sin(b) - np.sin(a), np.cos(a) - np.cos(b)
    return np.asarray(np.concatenate([cosines, sines], axis=1) / np.tile(b - a, 2))
