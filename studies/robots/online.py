"""Friction learned online: time to 5 %, coverage at the stop, limits, payloads and step times.

``python -m studies.robots.online PART --urdf MODEL --limits FILE --seeds 20`` appends rows to
``docs/robots_online.csv``; PART is times, coverage, payload or steps. A robot of the study has
friction, noise and ripple from its seed.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dopt.robots.body import Body, Motion
from dopt.robots.explorer import RobotExplorer
from dopt.robots.friction import SPEEDS, FrictionLearner, window_size
from dopt.robots.limits import Limits
from dopt.robots.tracking import KnownBody, Tracker, possible_acceleration
from dopt.types import Array
from studies.robots.simulated import CONTROL, SimulatedRobot, iiwa, jaco

FILE = Path("docs/robots_online.csv")

LOOK = 50
"""Periods of control from one comparison with the truth to the next."""

CLOSE = 0.05
"""Root mean square error of a friction curve relative to its own, that counts as learned."""


@dataclasses.dataclass
class Trace:
    """What a run has shown, at times, (k,) [s].

    Attributes
    ----------
    errors : list of (n,)
        Root mean square errors of the curves, relative to the true curves'.
    constants : list of (n,)
        The larger relative error of Coulomb and viscous friction.
    shares : dict of str to float
        Largest shares of the limits taken: true positions and velocities, torques asked for.
    """

    times: list[float] = dataclasses.field(default_factory=list)
    errors: list[Array] = dataclasses.field(default_factory=list)
    constants: list[Array] = dataclasses.field(default_factory=list)
    shares: dict[str, float] = dataclasses.field(default_factory=dict)

    def settled(self, of: str = "errors") -> float:
        """Return the time from which every joint stays within 5 %, infinite if there is none."""
        outside = np.flatnonzero(np.max(getattr(self, of), axis=1) > CLOSE)
        if len(outside) == 0:
            return self.times[0]
        return self.times[outside[-1] + 1] if outside[-1] + 1 < len(self.times) else np.inf

    def look(self, robot: SimulatedRobot, learner: FrictionLearner) -> None:
        """Compare what is learned with the truth."""
        values, truth = learner.intervals()[0], true_values(robot)
        size = np.sqrt((truth[:, :-2] ** 2).mean(axis=1))
        missed = np.sqrt(((values - truth)[:, :-2] ** 2).mean(axis=1))
        self.times.append(robot.time)
        self.errors.append(missed / size)
        self.constants.append(np.abs(values / truth - 1.0)[:, -2:].max(axis=1))

    def measure(self, robot: SimulatedRobot, torque: Array) -> None:
        """Note the shares of the limits."""
        limits = robot.limits
        half = np.diff(limits.position, axis=1)[:, 0] / 2.0
        taken = {
            "position": (robot.q - limits.middle) / half,
            "velocity": robot.v / limits.velocity,
            "torque": torque / limits.torque,
        }
        for kind, share in taken.items():
            self.shares[kind] = max(self.shares.get(kind, 0.0), float(np.abs(share).max()))


def true_values(robot: SimulatedRobot) -> Array:
    """Return the truth of :meth:`FrictionLearner.intervals`, (n, 14), as parts of the limit."""
    limits, friction = robot.limits, robot.friction
    curve = friction.torques(SPEEDS[:, None] * limits.velocity).T
    constants = np.column_stack([friction.coulomb, friction.viscous * limits.velocity])
    result: Array = np.concatenate([curve, constants], axis=1) / limits.torque[:, None]
    return result


def explore(
    robot: SimulatedRobot, explorer: RobotExplorer, seconds: float, until_done: bool = False
) -> Trace:
    """Let an explorer move a robot."""
    trace = Trace()
    q, now = robot.state()
    for k in range(round(seconds / CONTROL)):
        torque = explorer.ask(q, now)
        robot.step(torque)
        q, now = robot.state()
        explorer.tell(q, torque)
        trace.measure(robot, torque)
        if not until_done and k % LOOK == LOOK - 1:
            trace.look(robot, explorer.learner)
        if until_done and explorer.done:
            break
    return trace


def learner_of(robot: SimulatedRobot) -> FrictionLearner:
    """Return the estimator of an explorer, without its planner."""
    known = KnownBody(robot.body)
    inertia = possible_acceleration(known, robot.limits)[1]
    size = window_size(inertia, robot.limits, CONTROL)
    return FrictionLearner(robot.limits, known.inverse, window=size)


def track(robot: SimulatedRobot, motion: Motion, learner: FrictionLearner) -> Trace:
    """Track a motion by computed torque with the friction learned so far, and learn from it.

    The robot is placed where the motion begins.
    """
    if abs(motion.dt - CONTROL) > 1e-9:
        motion = resampled(motion)
    known, trace = KnownBody(robot.body), Trace()
    tracker = Tracker(known, robot.limits, learner.torques, CONTROL)
    robot.place(motion.positions[0])
    tracker.place(motion.positions[0])
    rows: list[tuple[Array, Array]] = []
    previous = np.zeros(robot.body.n)
    for k in range(len(motion.positions)):
        q, _ = robot.state()
        if k:
            tracker.predict(previous)
            tracker.correct(q)
        if len(rows) == learner.window.size:
            positions = np.array([*(p for p, _ in rows), q])
            torques = np.array([*(u for _, u in rows), 0.0 * q])
            rates = motion.velocities[k - len(rows) : k]
            learner.learn(learner.window.means(positions, torques), rates)
            rows = []
        previous = motion.accelerations[k]
        torque = tracker.torque(motion.positions[k], motion.velocities[k], previous)
        robot.step(torque)
        rows.append((q, torque))
        trace.measure(robot, torque)
        if k % LOOK == LOOK - 1:
            trace.look(robot, learner)
    return trace


def resampled(motion: Motion) -> Motion:
    """Return a motion at 500 Hz, by linear interpolation of its rows."""
    times = np.arange(0.0, motion.times[-1], CONTROL)

    def at(rows: Array) -> Array:
        return np.column_stack([np.interp(times, motion.times, row) for row in rows.T])

    parts = (motion.positions, motion.velocities, motion.accelerations)
    return Motion(CONTROL, *(at(part) for part in parts))
