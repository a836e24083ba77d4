"""Friction learned online: time to 5 %, coverage at the stop, limits, payloads and step times.

``python -m studies.robots.online PART --urdf MODEL --seeds 20`` appends rows to
``docs/robots_online.csv``; PART is times, coverage, payload or steps. A robot of the study has
friction, noise and ripple from its seed.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from dopt.robots.body import Body, KnownBody, Motion
from dopt.robots.design import DRAWN, REFERENCES, Design, Problem
from dopt.robots.explorer import RobotExplorer
from dopt.robots.friction import SPEEDS, FrictionLearner, window_size
from dopt.robots.limits import Limits
from dopt.robots.tracking import Tracker, possible_acceleration
from dopt.robots.trajectories import Multisine
from dopt.types import Array
from studies.robots.simulated import CONTROL, LIMITS, SimulatedRobot, iiwa, jaco

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
        """Return the time from which every joint stays within 5 %, infinite if it never does."""
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
        state = Motion(CONTROL, robot.q, robot.v, 0.0 * robot.v)
        taken = robot.limits.parts(state, torque)
        del taken["acceleration"]
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
    known, trace = KnownBody(robot.body), Trace()
    tracker = Tracker(known, robot.limits, learner.feedforward, CONTROL)
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


@dataclasses.dataclass(frozen=True)
class Row:
    """Measured quantity of one run, or of all runs of a case."""

    part: str
    arm: str
    case: str
    seed: int
    quantity: str
    value: float


def coverage(name: str, body: Body, limits: Limits, seeds: range) -> Iterator[Row]:
    """Stop at 5 % and look which intervals hold, and how wide they are beside fixed-time ones."""
    for seed in seeds:
        robot = SimulatedRobot(body, limits, seed)
        explorer = RobotExplorer(body, limits, stop={"curve": CLOSE}, seed=seed)
        trace = explore(robot, explorer, 40.0, until_done=True)
        values, half = explorer.learner.intervals()
        held = np.abs(values - true_values(robot)) <= half
        ratio = half / (1.96 * explorer.learner.deviations())
        found = {
            "stopped": float(explorer.done),
            "seconds": robot.time,
            "held: curve": held[:, :-2].mean(),
            "held: Coulomb": held[:, -2].mean(),
            "held: viscous": held[:, -1].mean(),
            "width beside a fixed time's: curve": np.median(ratio[:, :-2]),
            "width beside a fixed time's: constants": np.median(ratio[:, -2:]),
            "false alarms": explorer.counts["changed"],
            **{f"share of limit: {kind}": share for kind, share in trace.shares.items()},
        }
        for quantity, value in found.items():
            yield Row("coverage", name, "at the stop", seed, quantity, float(value))


def times(name: str, body: Body, limits: Limits, seeds: range) -> Iterator[Row]:
    """Time until every joint's curve stays within 5 %, online and by motions designed before."""
    seconds = 8.0
    for friction, label in (("coulomb_viscous", "online"), ("network", "online, network")):
        for seed in seeds:
            robot = SimulatedRobot(body, limits, seed)
            explorer = RobotExplorer(body, limits, friction=friction, seed=seed)
            yield from _settled(name, label, seed, explore(robot, explorer, seconds))
    designs = dict(_designs(body, limits, seconds))
    multisine = Multisine(limits, seconds)
    for seed in seeds:
        numbers = np.random.default_rng(seed).standard_normal(multisine.size)
        motions = {"random multisine": multisine.motion(numbers, CONTROL), **designs}
        for label, motion in motions.items():
            robot = SimulatedRobot(body, limits, seed)
            trace = track(robot, motion, learner_of(robot))
            yield from _settled(name, label, seed, trace)


def _designs(body: Body, limits: Limits, seconds: float) -> Iterator[tuple[str, Motion]]:
    """Yield motions for friction that are chosen before the run."""
    problem = Problem(body, limits, "damping,frictionloss", seconds, nuisance="")
    found = {one.name: one.motion(CONTROL) for one in Design.of(problem).candidates}
    yield f"multisine, best of {REFERENCES}", found.pop("multisine")
    yield "D-optimal design", found.pop("spline")
    for name, motion in found.items():
        yield f"{name}, best of {DRAWN}", motion


def _settled(name: str, label: str, seed: int, trace: Trace) -> Iterator[Row]:
    found = {
        "seconds to 5 %": trace.settled(),
        "seconds to 5 %: constants": trace.settled("constants"),
        "error at the end": float(np.max(trace.errors[-1])),
        **{f"share of limit: {kind}": share for kind, share in trace.shares.items()},
    }
    for quantity, value in found.items():
        yield Row("times", name, label, seed, quantity, float(value))


def payload(name: str, body: Body, limits: Limits, seeds: range) -> Iterator[Row]:
    """Hang 5 or 15 % of the arm's mass on the last body after 6 s, and see what is said of it."""
    whole = float(body.model.body_mass.sum())
    for mass, seed in itertools.product((0.05 * whole, 0.15 * whole), seeds):
        robot = SimulatedRobot(body, limits, seed, payload=(6.0, mass))
        explorer = RobotExplorer(body, limits, seed=seed)
        before = float(explorer.known.model.body_mass[body.moved[-1]])
        noticed = np.inf
        trace, q = Trace(), robot.state()[0]
        for k in range(9000):
            torque = explorer.ask(q)
            robot.step(torque)
            q, now = robot.state()
            explorer.tell(q, torque)
            trace.measure(robot, torque)
            if explorer.counts["changed"] and noticed == np.inf:
                noticed = now
            if k % LOOK == LOOK - 1:
                trace.look(robot, explorer.learner)
        values, half = explorer.learner.intervals()
        after = float(explorer.known.model.body_mass[body.moved[-1]])
        found = {
            "seconds until noticed": noticed - 6.0,
            "said": explorer.counts["changed"],
            "mass [kg]": mass,
            "estimated mass [kg]": after - before,
            **weighed(robot, explorer, mass),
            "held: curve": (np.abs(values - true_values(robot)) <= half)[:, :-2].mean(),
            "error at the end": float(np.max(trace.errors[-1])),
            **{f"share of limit: {kind}": share for kind, share in trace.shares.items()},
        }
        for quantity, value in found.items():
            yield Row("payload", name, f"{mass:.2f} kg", seed, quantity, float(value))


def weighed(robot: SimulatedRobot, explorer: RobotExplorer, mass: float) -> dict[str, float]:
    """Return errors of the payload's mass and first moment by their standard errors."""
    if explorer.payload is None:
        return {}
    (found, covariance), true = explorer.payload, robot.ball(mass)[:4]
    by = (found - true) / np.sqrt(np.diag(covariance))
    names = ("mass", "moment x", "moment y", "moment z")
    return {f"error by standard error: {one}": x for one, x in zip(names, by, strict=True)}


def steps(name: str, body: Body, limits: Limits, seeds: range) -> Iterator[Row]:
    """Processor time of a step beside the engine, the mean of 2,000."""
    for seed in seeds:
        for inputs in ("references", "torques"):
            for friction in ("coulomb_viscous", "network"):
                robot = SimulatedRobot(body, limits, seed)
                explorer = RobotExplorer(body, limits, inputs=inputs, friction=friction, seed=seed)
                spent, q = [0.0, 0.0], robot.state()[0]
                for _ in range(2000):
                    began = time.thread_time()
                    torque = explorer.ask(q)
                    asked = time.thread_time()
                    robot.step(torque)
                    q = robot.state()[0]
                    told = time.thread_time()
                    explorer.tell(q, torque)
                    spent[0] += asked - began
                    spent[1] += time.thread_time() - told
                for what, total in zip(("ask", "tell"), spent, strict=True):
                    quantity = f"{what}: milliseconds of processor time a step"
                    yield Row("steps", name, f"{inputs}, {friction}", seed, quantity, total / 2.0)


PARTS = {"coverage": coverage, "times": times, "payload": payload, "steps": steps}


def main() -> None:
    """Measure a part on both arms, and append its rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--urdf", type=Path, help="model of the iiwa; without it, the other arm")
    parser.add_argument("--limits", type=Path, default=LIMITS, help="limits of the iiwa")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--arm", choices=("iiwa", "jaco"), help="one arm alone")
    parser.add_argument("--out", type=Path, default=FILE)
    given = parser.parse_args()
    arms = {"jaco": jaco()}
    if given.urdf:
        arms["iiwa"] = iiwa(given.urdf, given.limits)
    fresh = not given.out.exists()
    with given.out.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if fresh:
            writer.writerow([field.name for field in dataclasses.fields(Row)])
        for name, (body, limits) in arms.items():
            if given.arm in (None, name):
                seeds = range(given.first, given.first + given.seeds)
                for row in PARTS[given.part](name, body, limits, seeds):
                    writer.writerow([*dataclasses.astuple(row)[:-1], f"{row.value:.6g}"])
                    file.flush()
    summary(given.out, given.part)


def summary(file: Path, part: str) -> None:
    """Print the median, the mean and the worst of each quantity."""
    table = pd.read_csv(file)
    rows = table[table.part == part].groupby(["arm", "case", "quantity"]).value
    sys.stdout.write(rows.agg(["count", "median", "mean", "min", "max"]).to_string() + "\n")


if __name__ == "__main__":
    main()
