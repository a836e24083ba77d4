"""Command ``design``: which motion identifies a robot's unknown parameters, and what none can."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orchestrate.commands import Command, answer
from orchestrate.errors import ExitCode
from orchestrate.files import whole, writing
from orchestrate.program import UsageError, integer, path, positive, tell

if TYPE_CHECKING:
    from dopt.robots.body import Motion
    from dopt.robots.design import Candidate, Design, Problem

SHOWN = 20
"""Rows of a list that are printed; --json has all."""

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
        default=None,
        metavar="NAMES",
        help="what is also unknown, but not asked for (damping,frictionloss; none: nothing)",
    )
    parser.add_argument(
        "--limits",
        type=path("--limits"),
        metavar="YAML",
        help="position, velocity, acceleration and torque of each joint (as in ROBOT)",
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
        help="time, positions, velocities, accelerations, torques; a picture beside it",
    )
    parser.add_argument(
        "--ros", type=path("--ros"), metavar="YAML", help="the motion as a ROS JointTrajectory"
    )


def _run(arguments: argparse.Namespace) -> ExitCode:
    from dopt.robots.body import Body  # SciPy and MuJoCo: other commands do without
    from dopt.robots.design import FRICTION, Problem
    from dopt.robots.limits import Limits

    if arguments.check and (arguments.out or arguments.ros):
        raise UsageError("--check designs no motion that could be written: leave out --out, --ros.")
    body = Body.load(arguments.robot)
    limits = Limits.of(body, arguments.limits)
    nuisance = FRICTION if arguments.nuisance is None else arguments.nuisance
    problem = Problem(
        body,
        limits,
        arguments.unknown,
        arguments.seconds,
        nuisance="" if nuisance == "none" else nuisance,
        noise=arguments.noise,
        rate=arguments.rate,
    )
    head = {"robot": str(arguments.robot), "joints": list(body.joints)}
    head |= {"notes": [*body.notes, *limits.notes]}
    return (_check if arguments.check else _design)(arguments, problem, head)


def _check(arguments: argparse.Namespace, problem: Problem, head: dict[str, Any]) -> ExitCode:
    """Say what the best of some random multisines can and cannot identify."""
    from dopt.robots.design import multisine

    best = multisine(problem, np.random.default_rng(arguments.seed))
    document = head | _told(problem, best)
    if obstacle := problem.obstacle(best):
        document["notes"].append(f"the best multisine breaks limits: {obstacle}")
    how = f"by the best of {document['motions']} random multisines of {problem.seconds:g} s"
    return answer(arguments, document, "\n".join([*_said(document), *_expected(document, how)]))


def _told(problem: Problem, best: Candidate) -> dict[str, Any]:
    """Return what a motion says of the parameters."""
    from dopt.robots.design import REFERENCES
    from dopt.robots.parameters import Identifiability

    found = Identifiability.of(problem.unknowns, best.motion(problem.step), problem.rate)
    return {
        "motions": REFERENCES,
        "seconds": problem.seconds,
        "null": found.null,
        "weak": found.weak,
        "parameters": [
            {
                "name": one.name,
                "unit": one.unit,
                "nominal": one.value,
                "half_width": 1.96 * float(error) * one.scale,
                "relative": 1.96 * float(error),
            }
            for one, error in zip(problem.requested, best.errors, strict=True)
        ],
    }


def _said(document: dict[str, Any]) -> list[str]:
    count = len(document["joints"])
    lines = [f"{document['robot']}: {count} joint{'s' if count > 1 else ''}"]
    lines += [f"note: {note}" for note in document["notes"]]
    lines += _listed(document["null"], "combinations that no motion can tell")
    lines += _listed(document["weak"], "parameters with standard errors above 100 %")
    return lines


def _listed(items: list[str], what: str) -> list[str]:
    if not items:
        return [f"no {what}"]
    more = [f"  and {len(items) - SHOWN} more (--json)"] if len(items) > SHOWN else []
    return [
        f"{len(items)} {what if len(items) > 1 else what.replace('s ', ' ', 1)}:",
        *(f"  {item}" for item in items[:SHOWN]),
        *more,
    ]


def _expected(document: dict[str, Any], how: str) -> list[str]:
    """Return the expected intervals, the least certain first; what is not measured ends them."""
    rows = sorted(document["parameters"], key=lambda row: -row["relative"])
    known = [row for row in rows if row["relative"] < 1.96 / math.sqrt(2.0)]
    lines = [
        f"expected half-widths of 95 % intervals, {how}, if each parameter is known to about its "
        f"own size before:"
    ]
    for row in known[:SHOWN]:
        percent = f"{100.0 * row['relative']:.3g} %"
        lines.append(
            f"  {row['name']:<40} {row['nominal']:>10.4g} ± {row['half_width']:<9.3g} "
            f"{row['unit']:<12} {percent}"
        )
    if len(known) > SHOWN:
        lines.append(f"  and {len(known) - SHOWN} that are better (--json)")
    if len(known) < len(rows):
        lines.append(f"  and {len(rows) - len(known)} of which this says little or nothing")
    return lines


def _design(arguments: argparse.Namespace, problem: Problem, head: dict[str, Any]) -> ExitCode:
    from dopt.robots.design import Design

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
    document = head | _told(problem, design.best)
    document |= {"best": design.best.name, "candidates": _candidates(design), "gap": design.gap}
    strain = float(problem.strains(motion).max())
    document["limits"] = problem.limits.shares(motion) | {"torque": strain}
    written = []
    if arguments.out:
        _write_csv(arguments.out, problem, motion)
        picture = arguments.out.with_suffix(".png")
        _draw(picture, problem, motion)
        written += [f"motion: {arguments.out}", f"picture: {picture}"]
    if arguments.ros:
        _write_ros(arguments.ros, problem, motion)
        written.append(f"JointTrajectory: {arguments.ros}")
    document["written"] = written
    lines = [*_said(document), *_table(design), *_taken(document)]
    lines += _expected(document, f"by {design.best.name}, {problem.seconds:g} s")
    return answer(arguments, document, "\n".join([*lines, *written]))


def _candidates(design: Design) -> list[dict[str, Any]]:
    reference = design.reference
    return [
        {
            "name": one.name,
            "share": one.share,
            "error_by_reference": math.exp(float(np.log(one.errors / reference).mean())),
            "worst_by_reference": float((one.errors / reference).max()),
            "within_limits": one.free,
        }
        for one in design.candidates
    ]


def _table(design: Design) -> list[str]:
    head = f"{'motion':<20} {'information':>12} {'errors':>8} {'worst':>8}"
    lines = [head]
    for row in _candidates(design):
        kept = "" if row["within_limits"] else "  breaks limits"
        lines.append(
            f"{row['name']:<20} {100.0 * row['share']:>10.1f} % {row['error_by_reference']:>8.2f} "
            f"{row['worst_by_reference']:>8.2f}{kept}"
        )
    lines.append(
        "information: share of the attainable one for each parameter; errors and worst: standard "
        "errors by the median of random multisines, their geometric mean and the largest"
    )
    return lines


def _taken(document: dict[str, Any]) -> list[str]:
    parts = [f"{kind} {100.0 * share:.0f} %" for kind, share in document["limits"].items()]
    return [f"of the limits, {document['best']} takes: {', '.join(parts)}; no bodies touch"]


def _write_csv(target: Path, problem: Problem, motion: Motion) -> None:
    torques = problem.body.torques(motion)
    names = [f"{kind}_{j}" for kind in ("q", "dq", "ddq", "tau") for j in problem.body.joints]
    parts = (motion.positions, motion.velocities, motion.accelerations, torques)
    rows = np.column_stack([motion.times, *parts])
    with whole(target) as partial:
        head = ",".join(["time", *names])
        np.savetxt(partial, rows, fmt="%.9g", delimiter=",", header=head, comments="")


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
        one.set_ylabel(name, rotation=0, ha="right", fontsize=7)
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
