"""Command ``design``: which motion identifies a robot's unknown parameters, and what none can."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrate.commands import Command, answer
from orchestrate.errors import ExitCode, whole, writing
from orchestrate.program import UsageError, integer, path, positive, tell

if TYPE_CHECKING:
    from dopt.robots.body import Motion
    from dopt.robots.design import Problem
    from dopt.robots.report import Report

ROS_STEP = 0.01
"""Least time between two points of a JointTrajectory [s]."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", type=path("ROBOT"), metavar="ROBOT", help="MJCF or URDF file")
    parser.add_argument(
        "--unknown",
        required=True,
        metavar="NAMES",
        help="parameters to identify, such as damping,frictionloss,armature,mass:link7: mass, com, "
        "inertia of bodies; armature, damping, frictionloss, gear of joints; all",
    )
    parser.add_argument(
        "--nuisance",
        default="damping,frictionloss",
        metavar="NAMES",
        help="what is also unknown, but not asked for (damping,frictionloss; none: nothing)",
    )
    parser.add_argument(
        "--limits",
        type=path("--limits"),
        metavar="YAML",
        help="position, velocity, acceleration and torque of each joint, behind its gear, in rad "
        "and N m, or m and N of slides (as in ROBOT)",
    )
    parser.add_argument("--check", action="store_true", help="say only what is identifiable")
    parser.add_argument("--seed", type=integer("--seed"), default=0, help="seed of the search (0)")
    noise = "standard deviation of a measured torque, as a share of its limit"
    rate = "independent measurements a second, and rows of the CSV file [Hz]"
    effort = "motions that are tried to improve the best random one"
    for option, default, text in (
        ("--seconds", 20.0, "duration [s]"),
        ("--noise", 0.01, noise),
        ("--rate", 500.0, rate),
        ("--effort", 40, effort),
    ):
        number = positive(option, type(default))
        parser.add_argument(option, type=number, default=default, help=f"{text} ({default:g})")
    parser.add_argument(
        "--out",
        type=path("--out"),
        metavar="CSV",
        help="time, positions, velocities, accelerations, torques, in units of the limits; a "
        "picture beside it",
    )
    parser.add_argument(
        "--ros", type=path("--ros"), metavar="YAML", help="the motion as a ROS JointTrajectory"
    )


def _run(arguments: argparse.Namespace) -> ExitCode:
    from dopt.robots.body import Body  # SciPy and MuJoCo: other commands do without
    from dopt.robots.design import Problem
    from dopt.robots.limits import Limits
    from dopt.robots.report import Report

    if arguments.check and (arguments.out or arguments.ros):
        raise UsageError("--check designs no motion that could be written: leave out --out, --ros.")
    out, read = arguments.out, (arguments.robot, arguments.limits)
    files = [one.resolve() for one in (out, out and out.with_suffix(".png"), arguments.ros) if one]
    if {*files} & {one.resolve() for one in read if one} or len({*files}) < len(files):
        raise UsageError(
            f"--out {out} with its picture, --ros {arguments.ros} and the files that are read have "
            f"a name twice, but each is another file: give names such as --out motion.csv --ros "
            f"motion.yaml."
        )
    body = Body.load(arguments.robot)
    limits = Limits.of(body, arguments.limits)
    problem = Problem(
        body,
        limits,
        arguments.unknown,
        arguments.seconds,
        nuisance="" if arguments.nuisance == "none" else arguments.nuisance,
        noise=arguments.noise,
        rate=arguments.rate,
    )
    if arguments.check:
        return _answer(arguments, Report.check(problem, arguments.seed))
    return _design(arguments, problem)


def _answer(arguments: argparse.Namespace, report: Report, written: Sequence[str] = ()) -> ExitCode:
    count = len(report["joints"])
    head = f"{arguments.robot}: {count} joint{'s' if count > 1 else ''}"
    document = {"robot": str(arguments.robot), **report}
    if not arguments.check:
        document["written"] = list(written)
    return answer(arguments, document, "\n".join([head, str(report), *written]))


def _design(arguments: argparse.Namespace, problem: Problem) -> ExitCode:
    from dopt.robots.design import Design
    from dopt.robots.report import Report

    for option, target in (("--out", arguments.out), ("--ros", arguments.ros)):
        if target:  # before minutes of search
            with writing(target, option):
                target.parent.mkdir(parents=True, exist_ok=True)
    design = Design.of(
        problem,
        seed=arguments.seed,
        effort=arguments.effort,
        progress=lambda line: tell(sys.stderr, f"{line}\n"),
    )
    motion = design.best.motion(1.0 / arguments.rate)
    written = []
    if arguments.out:
        _write_csv(arguments.out, problem, motion)
        picture = arguments.out.with_suffix(".png")
        _draw(picture, problem, motion)
        written += [f"motion: {arguments.out}", f"picture: {picture}"]
    if arguments.ros:
        _write_ros(arguments.ros, problem, motion)
        written.append(f"JointTrajectory: {arguments.ros}")
    return _answer(arguments, Report.of(design), written)


def _write_csv(target: Path, problem: Problem, motion: Motion) -> None:
    import pandas as pd

    columns = pd.DataFrame(problem.body.columns(motion))
    with whole(target) as partial:
        columns.to_csv(partial, index=False, float_format="%.9g", compression=None)


def _write_ros(target: Path, problem: Problem, motion: Motion) -> None:
    """Write the fields of trajectory_msgs/JointTrajectory, a point in a line."""
    step = max(1, math.ceil(ROS_STEP / motion.dt - 1e-9))
    few = motion.every(step)
    torques = problem.body.torques(few)
    lines = [f"joint_names: {json.dumps(list(problem.body.joints))}", "points:"]
    for t, q, v, a, tau in zip(
        few.times, few.positions, few.velocities, few.accelerations, torques, strict=True
    ):
        after = {"sec": int(t), "nanosec": round((t - int(t)) * 1e9)}
        named = {"positions": q, "velocities": v, "accelerations": a, "effort": tau}
        point = {kind: [float(f"{x:.9g}") for x in row] for kind, row in named.items()}
        lines.append(f"- {json.dumps(point | {'time_from_start': after})}")
    with whole(target, "--ros") as partial:
        partial.write_text("\n".join([*lines, ""]))


def _draw(target: Path, problem: Problem, motion: Motion) -> None:
    """Draw positions, velocities and torques of each joint, as shares of their limits."""
    from matplotlib.figure import Figure

    parts = problem.limits.parts(motion, problem.body.torques(motion))
    del parts["acceleration"]
    figure = Figure((8.0, 1.0 + 0.9 * problem.body.n), layout="constrained")
    axes = figure.subplots(problem.body.n, 1, sharex=True, squeeze=False)[:, 0]
    for k, (name, one) in enumerate(zip(problem.body.joints, axes, strict=True)):
        for kind, part in parts.items():
            one.plot(motion.times, part[:, k], lw=0.8, label=kind)
        one.set(ylim=(-1.05, 1.05), yticks=(-1, 0, 1))
        one.set_ylabel(name.replace("$", r"\$"), rotation=0, ha="right", fontsize=7)
    axes[0].legend(ncols=3, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[-1].set(xlabel="time [s]")
    figure.supylabel("share of the limit", fontsize=8)
    with whole(target) as partial:
        figure.savefig(partial, dpi=100)


DESIGN_COMMAND = Command(
    "design",
    "motion of a robot that identifies its unknown parameters",
    _run,
    _add_arguments,
    needs_database=False,
)
