"""Designs for many unknowns: expected errors by multisines, and errors of fits after them.

``python -m studies.robots.designs --urdf MODEL --seeds 20`` appends a row for each
arm and seed to ``docs/robots_designs.csv``. The seed draws the multisines, the search, and a robot
whose parameters differ from the file's: logarithms of positive ones have a standard deviation of
.1, centres a tenth of their sizes. Torques are measured with white noise.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from dopt.robots.body import Body, KnownBody, Motion
from dopt.robots.design import COARSE, EFFORT, Design, Problem
from dopt.robots.limits import Limits
from dopt.robots.parameters import SLOW, Identifiability, Unknowns
from dopt.robots.tracking import Tracker, possible_acceleration
from dopt.types import Array
from studies.robots.simulated import CONTROL, LIMITS, Friction, SimulatedRobot, iiwa, jaco

FILE = Path("docs/robots_designs.csv")

UNKNOWN = "mass,com,inertia,armature,damping,frictionloss,gear"

OFF = 0.1
"""Standard deviation of a true parameter about the file's, of its logarithm or by its size."""

WINDOW = 31
"""Samples of a local cubic: 62 ms."""

FAR = 1.5
"""Errors by expected ones that count as too large."""

TURNING = 3.0
"""Multiple of the width of dry friction's sign below which rates tell too little of the sign."""

KNOWN = 0.3
"""Share of the prior standard deviation below which an expected error is compared with a fit's."""


def measured(robot: SimulatedRobot, nominal: Body, gears: Array, motion: Motion) -> Array:
    """Track a motion with the nominal body; return positions and commands, (T, 2, n)."""
    model, friction = nominal.model, nominal.dofs
    damping, dry = model.dof_damping[friction], model.dof_frictionloss[friction]
    speed = SLOW * robot.limits.velocity

    def expected(v: Array) -> Array:
        torques: Array = damping * v + dry * np.tanh(v / speed)
        return torques

    tracker = Tracker(KnownBody(nominal), robot.limits, expected, CONTROL)
    robot.place(motion.positions[0])
    tracker.place(motion.positions[0])
    rows = []
    for k in range(len(motion.positions)):
        q, _ = robot.state()
        if k:
            tracker.predict(motion.accelerations[k - 1])
            tracker.correct(q)
        torque = tracker.torque(motion.positions[k], motion.velocities[k], motion.accelerations[k])
        robot.step(gears * torque)
        rows.append((q, torque))
    return np.array(rows)


def smoothed(rows: Array, reference: Motion) -> Motion:
    """Return the motion that encoders have seen: the reference and its error, smoothed.

    The error is a response to the noise of the torques, within the bandwidth of the tracking; local
    cubics estimate it and its two derivatives. Speeds of a ladder stay as sharp as they are.
    """
    error = rows[:, 0] - reference.positions
    q, v, a = (
        savgol_filter(error, WINDOW, 3, deriv=order, delta=CONTROL, axis=0) for order in range(3)
    )
    parts = reference.positions + q, reference.velocities + v, reference.accelerations + a
    return held(Motion(CONTROL, *parts))


def held(motion: Motion) -> Motion:
    """Return the means of a motion while each torque is held, without its ends."""
    inner = slice(WINDOW, -WINDOW)
    q, v = motion.positions, motion.velocities
    positions, velocities = (0.5 * (part[1:] + part[:-1])[inner] for part in (q, v))
    return Motion(CONTROL, positions, velocities, (np.diff(v, axis=0) / CONTROL)[inner])


def values_of(unknowns: Unknowns, changes: Array) -> tuple[Array, Array]:
    """Return values of parameters and their derivatives by changes from the file's, (p,) each.

    Changes are logarithms of positive parameters, which stay positive, and shares of the sizes of
    the others. Derivatives are in units of the sizes.
    """
    values, slopes = unknowns.values, np.exp(changes)
    centres = np.array([one.kind.startswith("com") for one in unknowns.parameters])
    shifted = centres | (values == 0.0)
    moved = np.where(shifted, values + changes * unknowns.scales, values * slopes)
    return moved, np.where(shifted, 1.0, slopes)


def fitted(problem: Problem, rows: Array, reference: Motion) -> Array:
    """Return the changes of the parameters by three steps of Gauss and Newton, (p,).

    Their prior standard deviation is :data:`OFF`: a motion says little of some. In logarithms it is
    a relative one at all values; about the values themselves, it draws what multiplies many
    parameters, such as gears, towards 0.

    Regressors at the reference, which has no noise, are the instruments: A. Janot, P.-O. Vandanjon,
    M. Gautier, "A generic instrumental variable approach for industrial robot identification", IEEE
    Trans. Control Systems Technology 22, 1 (2014). Least squares alone would be biased by the noise
    of the encoders.
    """
    motion, commands = smoothed(rows, reference), rows[:-1, 1][WINDOW:-WINDOW]
    planned = held(reference)
    first, found = problem.unknowns, np.zeros(len(problem.unknowns))
    prior = np.eye(len(found)) / OFF**2
    slow = SLOW * problem.limits.velocity
    noise = first.noise * problem.limits.torque / np.sqrt(problem.rate * CONTROL)
    moving = np.abs(planned.velocities) > TURNING * slow
    for _ in range(3):
        values, slopes = values_of(first, found)
        unknowns, gears = first.at(values)
        body = unknowns.body
        damping, dry = body.model.dof_damping[body.dofs], body.model.dof_frictionloss[body.dofs]
        v = motion.velocities
        expected = body.torques(motion) + damping * v + dry * np.tanh(v / slow)
        scale = (moving / (gears * noise))[:, :, None]
        x, z = (
            (unknowns.regressor(one) * scale).reshape(-1, len(found)) * slopes
            for one in (motion, planned)
        )
        left = (moving * (commands - expected / gears) / noise).reshape(-1)
        found = found + np.linalg.solve(z.T @ x + prior, z.T @ left - prior @ found)
    return found


def chance(covariance: Array) -> float:
    """Return how often the root mean square of errors by expected ones exceeds :data:`FAR`."""
    sizes = np.sqrt(np.diag(covariance))
    spread = np.linalg.eigvalsh(covariance / np.outer(sizes, sizes)) / len(sizes)
    squares = np.random.default_rng(0).standard_normal((10000, len(sizes))) ** 2 @ spread
    return float((squares > FAR**2).mean())


def row(arm: str, body: Body, limits: Limits, seed: int, effort: int) -> dict[str, object]:
    """Design, simulate a robot on the motion, fit, and compare."""
    began = time.process_time()
    problem = Problem(body, limits, UNKNOWN, 20.0, nuisance="")
    design = Design.of(problem, seed=seed, effort=effort)
    spent = time.process_time() - began
    best = design.best
    seen = Identifiability.of(problem.unknowns, best.motion(COARSE), problem.rate)
    known = design.reference < 0.5
    ratio = best.errors / design.reference
    rng = np.random.default_rng([seed, 47])
    off = OFF * rng.standard_normal(problem.count)
    centres = np.array([one.kind.startswith("com") for one in problem.requested])
    off = np.where((problem.unknowns.values == 0.0) & ~centres, np.abs(off), off)
    unknowns, gears = problem.unknowns.at(values_of(problem.unknowns, off)[0])
    true, model = unknowns.body, unknowns.body.model
    friction = Friction(
        coulomb=np.abs(model.dof_frictionloss[true.dofs]),
        viscous=np.abs(model.dof_damping[true.dofs]),
        stribeck=np.zeros(body.n),
        width=np.ones(body.n),
        smooth=SLOW * limits.velocity,
    )
    robot = SimulatedRobot(true, limits, seed, friction, noise=0.0, ripple=0.0)
    motion = best.motion(CONTROL)
    rows = measured(robot, body, gears, motion)
    rows[:, 1] += problem.unknowns.noise * limits.torque * rng.standard_normal(rows[:, 1].shape)
    # Errors that are expected with the prior of the fit, as shares of its standard deviation.
    information = OFF**2 * problem.information(best.motion(COARSE))
    covariance = np.array(np.linalg.inv(information + np.eye(len(off))), dtype=float)
    shares = np.sqrt(np.diag(covariance))
    told = shares < KNOWN
    z = ((fitted(problem, rows, motion) - off) / (OFF * shares))[told]
    return {
        "arm": arm,
        "seed": seed,
        "motion": best.name,
        "unknowns": problem.count,
        "null": len(seen.null),
        "known": int(known.sum()),
        "ratio": float(np.exp(np.log(ratio[known]).mean())),
        "ratio_all": float(np.exp(np.log(ratio).mean())),
        "worst": float(ratio.max()),
        "share": best.share,
        "fitted": len(z),
        "achieved": float(np.sqrt((z**2).mean())),
        "achieved_worst": float(np.abs(z).max()),
        "chance": chance(covariance[np.ix_(told, told)]),
        "cpu_seconds": spent,
    }


def main() -> None:
    """Append the rows that are missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--urdf", type=Path, help="URDF of the iiwa")
    parser.add_argument("--limits", type=Path, default=LIMITS, help="its limits")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--effort", type=int, default=EFFORT)
    given = parser.parse_args()
    arms = {"jaco": jaco()} | ({"iiwa": iiwa(given.urdf, given.limits)} if given.urdf else {})
    done = set()
    if FILE.exists():
        with FILE.open() as file:
            done = {(one["arm"], int(one["seed"])) for one in csv.DictReader(file)}
    for seed in range(given.seeds):
        for arm, (body, limits) in arms.items():
            if (arm, seed) in done:
                continue
            if arm == "jaco":
                possible, _ = possible_acceleration(KnownBody(body), limits)
                limits = Limits(limits.position, limits.velocity, possible, limits.torque)
            one = row(arm, body, limits, seed, given.effort)
            with FILE.open("a", newline="") as file:
                writer = csv.DictWriter(file, one, lineterminator="\n")
                if not file.tell():
                    writer.writeheader()
                writer.writerow(
                    {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in one.items()}
                )
            sys.stdout.write(f"{arm} {seed}: {one['ratio']:.3f} of the multisines\n")


if __name__ == "__main__":
    main()
