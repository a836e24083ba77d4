"""Limits of a robot's joints, from files, with what looks wrong in them."""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as Xml
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dopt.arguments import finite, within
from dopt.errors import SpecificationError, given_path, unknown_name
from dopt.robots.body import Body, Motion, actuators, listed, poses
from dopt.types import Array

KINDS = ("position", "velocity", "acceleration", "torque")
"""Kinds of limits, in rad or m, per s, per s², and N m or N."""

STOPPING = 0.2
"""Seconds from the largest velocity to rest: the acceleration where none is given."""

FAST, STRONG = 2.0 * math.pi, 300.0
"""Velocity [rad/s] and torque [N m] from which equal limits of all joints look like defaults."""

WIDE = 1e3
"""Torques of this size in a robot's file count as no limit."""

TINY = 1e-3
"""Friction, as a share of the limit of torque, below which it looks like a default."""

POSES = 1000
"""Random positions in which a robot's weight is compared with its limits of torque."""

INTEGRATOR = 1
"""Dynamics of an actuator, whose control is a rate of its force."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of n joints.

    Attributes
    ----------
    position : (n, 2)
        Least and largest [rad or m].
    velocity, acceleration, torque : (n,)
        Largest magnitudes.
    notes : tuple of str
        What was assumed, and what looks like a default.
    """

    position: Array
    velocity: Array
    acceleration: Array
    torque: Array
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, body: Body, file: str | Path | None = None) -> Limits:
        """Return the limits in a YAML file, completed by those in the robot's own file.

        The file holds, for each joint or for ``default``, some of ``position: [low, high]``,
        ``velocity``, ``acceleration`` and ``torque``, all under ``joints``:

            joints:
              default: {acceleration: 10}
              joint_1: {position: [-2.9, 2.9], velocity: 1.7, torque: 176}

        Raises
        ------
        SpecificationError
            If the file cannot be read, names another joint, or a limit is missing in both.
        """
        own = _own(body)
        given = {} if file is None else _given(body, Path(file))
        values = own | given
        missing = {
            kind: [name for name in body.joints if (name, kind) not in values]
            for kind in ("position", "velocity", "torque")
        }
        if any(missing.values()):
            raise _missing(body, missing)
        assumed = [name for name in body.joints if (name, "acceleration") not in values]
        for name in assumed:
            values[name, "acceleration"] = values[name, "velocity"] / STOPPING
        arrays = {kind: np.array([values[name, kind] for name in body.joints]) for kind in KINDS}
        notes = [*_suspicious(body, arrays, given), *_beyond(own, values)]
        if assumed:
            notes.append(
                f"no acceleration is given for {listed(assumed)}: the velocity in {STOPPING:g} s "
                f"is assumed"
            )
        return cls(**arrays, notes=tuple(notes))

    @property
    def middle(self) -> Array:
        """Middle of the ranges of position, (n,)."""
        return np.asarray(self.position.mean(axis=1))

    def parts(self, motion: Motion, torques: Array | None = None) -> dict[str, Array]:
        """Return a motion as parts of each kind of limit, (T, n); 1 and -1 are the limits."""
        half = np.diff(self.position, axis=1)[:, 0] / 2.0
        parts = {
            "position": (motion.positions - self.middle) / half,
            "velocity": motion.velocities / self.velocity,
            "acceleration": motion.accelerations / self.acceleration,
        }
        return parts if torques is None else parts | {"torque": torques / self.torque}

    def shares(self, motion: Motion) -> dict[str, float]:
        """Return the largest share of each kind of limit that a motion takes; 1 is the limit."""
        parts = self.parts(motion)
        return {kind: float(np.abs(part).max()) for kind, part in parts.items()}


def check_weight(body: Body, limits: Limits) -> None:
    """Refuse limits of torque that hold the body at rest in none of many random positions."""
    q = poses(limits.position, POSES)
    weights = np.abs(body.torques(Motion(1.0, q, *np.zeros((2, *q.shape)))))
    shares = weights / limits.torque
    best = int(shares.max(axis=1).argmin())
    k = int(shares[best].argmax())
    if shares[best, k] > 1.0:
        unit = body.units[k]
        raise SpecificationError(
            f"joint '{body.joints[k]}' takes {weights[best, k]:.3g} {unit} at rest, in the best of "
            f"{POSES} random positions, but its limit of torque is {limits.torque[k]:g} {unit}: "
            f"give a larger limit, or ranges of position in which it carries less."
        )


def _missing(body: Body, missing: Mapping[str, list[str]]) -> SpecificationError:
    """Return the error for limits that no file gives, with the lines that are to be filled in."""
    lacking = {kind: names for kind, names in missing.items() if names}
    said = "; ".join(f"{kind} of {listed(names)}" for kind, names in lacking.items())
    every = {kind for kind, names in lacking.items() if len(names) == body.n}
    lines = ["joints:"]
    for name in ("default", *body.joints):
        kinds = every if name == "default" else {k for k, n in lacking.items() if name in n} - every
        if kinds:
            blanks = [f"{k}: {'[…, …]' if k == 'position' else '…'}" for k in KINDS if k in kinds]
            lines.append(f"  {name}: {{{', '.join(blanks)}}}")
    return SpecificationError(
        f"limits are missing, but every joint needs its own (rad or m, per second, N m or N "
        f"behind the gear; {WIDE:g} or more in the robot's file counts as none): {said}. Fill in "
        f"these lines, and give them as a file of limits (--limits FILE):\n" + "\n".join(lines)
    )


def _own(body: Body) -> dict[tuple[str, str], Any]:
    """Return the limits in the robot's own file by joint and kind."""
    model, torques, velocities, own = body.model, _torques(body), _velocities(body.source), {}
    for name, j in zip(body.joints, model.dof_jntid[body.dofs], strict=True):
        if model.jnt_limited[j]:
            own[name, "position"] = model.jnt_range[j].tolist()
        if velocity := velocities.get(name):
            own[name, "velocity"] = velocity
        if 0.0 < torques[j] < WIDE:
            own[name, "torque"] = float(torques[j])
    return own


def _velocities(source: Path | None) -> dict[str | None, float]:
    """Return the limits of velocity in an URDF, by its joints; 0 where it has none."""
    try:
        joints = Xml.fromstring(source.read_bytes().strip()).iter("joint") if source else ()
    except Xml.ParseError:  # of a prefix that is not declared, which the engine lets pass
        return {}
    return {
        joint.get("name"): float(limit.get("velocity", 0.0))
        for joint in joints
        for limit in joint.findall("limit")
    }


def _torques(body: Body) -> Array:
    """Return the largest torque of every joint by its own range and its actuators."""
    model = body.model
    own = np.abs(model.jnt_actfrcrange).min(axis=1)
    found: Array = np.where(model.jnt_actfrclimited, own, math.inf)
    for a, j, gear, control in actuators(model):
        if model.actuator_forcelimited[a]:
            found[j] = min(found[j], abs(gear) * np.abs(model.actuator_forcerange[a]).min())
        plain = (model.actuator_gaintype[a], model.actuator_biastype[a]) == (0, 0)
        plain &= model.actuator_dyntype[a] != INTEGRATOR
        if plain and model.actuator_ctrllimited[control]:
            gain = abs(gear * model.actuator_gainprm[a, 0])
            found[j] = min(found[j], gain * np.abs(model.actuator_ctrlrange[control]).min())
    return found


def _given(body: Body, file: Path) -> dict[tuple[str, str], Any]:
    """Return the limits in a file by joint and kind."""
    import yaml  # type: ignore[import-untyped]  # it has no types

    source = given_path(str(file), "the file of limits", SpecificationError)
    try:
        sections = yaml.safe_load(source.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise SpecificationError(
            f"{source} cannot be read ({' '.join(str(error).split())}), but limits in YAML are "
            f"expected: correct it."
        ) from error
    sections = sections.get("joints") if isinstance(sections, Mapping) else None
    if not isinstance(sections, Mapping):
        raise SpecificationError(
            f"{source} has no mapping 'joints', but the limits of each joint are expected there, "
            f"such as 'joints: {{{body.joints[0]}: {{velocity: 2}}}}': correct it."
        )
    given = {}
    for name, section in sorted(sections.items(), key=lambda pair: pair[0] != "default"):
        if name != "default" and name not in body.joints:
            raise unknown_name("joint", str(name), body.joints)
        if not isinstance(section, Mapping):
            raise _unlike(f"{name} in {source}", section, "a mapping of limits")
        for kind, value in section.items():
            if kind not in KINDS:
                raise unknown_name(f"limit of joint '{name}'", str(kind), KINDS)
            value = _checked(f"{name}.{kind} in {source}", value, kind == "position")
            for joint in body.joints if name == "default" else [str(name)]:
                given[joint, kind] = value
    return given


def _checked(what: str, value: Any, is_range: bool) -> Any:
    """Return a positive number, or a range [low, high]; a number is the range about 0."""
    if not is_range:
        return within(what, value, math.inf)
    ends = [-abs(value), abs(value)] if type(value) in (int, float) else value
    low, high = finite(what, ends, 2).tolist()
    if low >= high:
        raise _unlike(what, value, "[low, high]")
    return [low, high]


def _suspicious(
    body: Body, limits: Mapping[str, Array], given: Mapping[tuple[str, str], Any]
) -> Iterator[str]:
    """Yield a sentence for each kind of limit that looks like a default of the robot's file."""
    for kind, size, unit in (("velocity", FAST, "rad/s"), ("torque", STRONG, "N m")):
        pairs = zip(limits[kind], body.joints, strict=True)
        own = [value for value, name in pairs if (name, kind) not in given]
        if len(own) > 2 and len(set(own)) == 1:
            looks = "looks like a default" if own[0] >= size else "may be a default"
            yield (
                f"every joint has the {kind} {own[0]:g} {unit}, which {looks}: look it up in the "
                f"robot's data sheet"
            )
    dry, viscous = body.model.dof_frictionloss[body.dofs], body.model.dof_damping[body.dofs]
    for kind, torques in (("frictionloss", dry), ("damping", viscous * limits["velocity"])):
        tiny = np.flatnonzero((torques > 0.0) & (torques < TINY * limits["torque"]))
        if tiny.size:
            yield (
                f"the {kind} of {listed([body.joints[k] for k in tiny])} is less than "
                f"{100.0 * TINY:g} % of the limit of torque, and counts as known to about its own "
                f"size: correct it in the robot's file if it is a default"
            )
    ranges = zip(body.joints, limits["position"], strict=True)
    if wide := [name for name, one in ranges if np.ptp(one) > 4 * np.pi]:
        yield f"the range of {listed(wide)} is more than two turns: check it"


def _beyond(own: Mapping[tuple[str, str], Any], values: Mapping[tuple[str, str], Any]) -> list[str]:
    """Return a sentence for each kind of limit that is beyond the one in the robot's file."""
    found: dict[str, list[str]] = {}
    for (name, kind), limit in own.items():
        lower = kind == "position" and values[name, kind][0] < limit[0]
        if lower or np.max(values[name, kind]) > np.max(limit):
            found.setdefault(kind, []).append(name)
    return [
        f"the {kind} of {listed(found[kind])} goes beyond the robot's file: check it"
        for kind in KINDS
        if kind in found
    ]


def _unlike(what: str, value: object, expected: str) -> SpecificationError:
    return SpecificationError(f"{what} is {value!r}, but {expected} is expected: correct it.")
