"""Unknown parameters of a robot: what torques say of them, and what they cannot say.

A torque is measured with white noise whose standard deviation is a share of the joint's limit. The
information of a motion about the parameters p is the sum of (∂τ/∂p)ᵀ Σ⁻¹ ∂τ/∂p over its samples.
"""

from __future__ import annotations

import copy
import dataclasses
import fnmatch
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg

from dopt.errors import SpecificationError, unknown_name
from dopt.robots.body import Body, Motion, inertial, settle
from dopt.robots.limits import Limits
from dopt.types import Array

OF_BODIES = {"mass": ("mass",), "com": ("com_x", "com_y", "com_z"), "inertia": ("Ix", "Iy", "Iz")}
"""Kinds of parameters of a body, and the parameters that each stands for.

Centres are in the body's frame, inertias are principal moments about the centre.
"""

OF_JOINTS = ("armature", "damping", "frictionloss", "gear")
"""Kinds of parameters of a joint. A gear is the torque at the joint by the commanded one."""

UNITS = {
    **{"mass": "kg", "com_x": "m", "com_y": "m", "com_z": "m"},
    **{"Ix": "kg m²", "Iy": "kg m²", "Iz": "kg m²", "armature": "kg m²"},
    **{"damping": "N m s/rad", "frictionloss": "N m", "gear": "N m/N m"},
}
OF_SLIDES = {"armature": "kg", "damping": "N s/m", "frictionloss": "N", "gear": "N/N"}
"""Units of the kinds of parameters; a joint that slides has ``OF_SLIDES``."""

FRICTION = 0.05
"""Share of the limit of torque that friction is taken to be where the file has none."""

SLOW = 0.01
"""Share of the limit of velocity at which dry friction has 76 % of its value."""

NULL = 1e-9
"""Share of the largest singular value below which a combination of parameters has no effect.

Files give angles to 9 digits or more: what is null with exact ones is below it.
"""

SMALL = 1e-5
"""Share of the largest part of a combination below which a part is left out."""

WEAK = 1.0
"""Standard error, as a share of the parameter, from which a parameter is called weak."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One unknown number.

    Attributes
    ----------
    kind : str
        Name in ``UNITS``.
    place : str
        Its body or joint.
    value : float
        Nominal value.
    scale : float
        Size that errors are relative to: the nominal value, or a typical one where that is 0.
    unit : str
    """

    kind: str
    place: str
    value: float
    scale: float
    unit: str

    @property
    def name(self) -> str:
        return f"{self.kind}:{self.place}"


class Unknowns:
    """The unknown parameters of a body.

    Parameters
    ----------
    body : Body
    limits : Limits
    wanted : str or sequence of str
        Kinds, each for all places or for one: ``"damping,frictionloss,mass:link7"``. Kinds are
        mass, com, inertia (of bodies), armature, damping, frictionloss, gear (of joints), and
        single parameters of them such as com_x; ``all`` stands for all kinds. Places may hold
        wildcards, ``mass:link*``.
    noise : float
        Standard deviation of a measured torque, as a share of the limit.

    Attributes
    ----------
    parameters : tuple of Parameter
        The p parameters.
    names : tuple of str
    values, scales : (p,)
        Nominal values, and the sizes that errors are relative to.

    Raises
    ------
    SpecificationError
        If a kind or a place is not known.
    """

    def __init__(
        self, body: Body, limits: Limits, wanted: str | Sequence[str], noise: float = 0.01
    ) -> None:
        self.body, self.limits, self.noise = body, limits, noise
        names = wanted.split(",") if isinstance(wanted, str) else list(wanted)
        found: dict[str, Parameter] = {}
        for name in filter(None, (one.strip() for one in names)):
            for parameter in self._matching(name):
                found[parameter.name] = parameter
        if not found:
            raise SpecificationError(
                f"no unknown parameter is given, but at least one is expected: give some of "
                f"{', '.join([*OF_BODIES, *OF_JOINTS])}."
            )
        self.parameters, self.names = tuple(found.values()), tuple(found)
        self.values, self.scales = np.array([(one.value, one.scale) for one in found.values()]).T
        self._directions = self._inertial_directions()

    def __len__(self) -> int:
        return len(self.parameters)

    def at(self, values: Array) -> tuple[Unknowns, Array]:
        """Return these parameters at other values, (p,), of the same scales, and the gears, (n,).

        :meth:`regressor` is then of the torque that a gear makes, ``gears`` times the command.
        """
        body, model = self.body, copy.copy(self.body.model)
        gears = np.ones(body.n)
        for one, value in zip(self.parameters, values, strict=True):
            if one.kind == "gear":
                gears[body.joints.index(one.place)] = value
            else:
                numbers, at = _numbers(body, model, one.kind, one.place)
                numbers[at] = value
        settle(model)
        result = copy.copy(self)
        result.body = Body(model, body.source)
        result._directions = result._inertial_directions()
        return result, gears

    def _matching(self, name: str) -> list[Parameter]:
        """Return the parameters that a name such as ``mass:link7`` stands for."""
        kind, _, place = name.partition(":")
        kinds: tuple[str, ...] = OF_BODIES.get(kind, (kind,))
        if kind == "all":
            kinds = tuple(UNITS)
        known = [*OF_BODIES, *UNITS, "all"]
        if not set(kinds) <= set(UNITS):
            raise unknown_name("kind of parameter", kind, dict.fromkeys(known))
        found = [
            self._parameter(one, where)
            for where in dict.fromkeys(self.body.bodies + self.body.joints)
            for one in kinds
            if where in (self.body.joints if one in OF_JOINTS else self.body.bodies)
            and (place in ("", where) or fnmatch.fnmatchcase(where, place))
        ]
        if not found:
            places = self.body.joints if kind in OF_JOINTS else self.body.bodies
            raise unknown_name("joint" if kind in OF_JOINTS else "body", place, places)
        return found

    def _parameter(self, kind: str, place: str) -> Parameter:
        body, limits, unit = self.body, self.limits, UNITS[kind]
        if kind in OF_JOINTS:
            k = body.joints.index(place)
            unit = OF_SLIDES[kind] if body.units[k] == "N" else unit
        if kind == "gear":
            return Parameter(kind, place, 1.0, 1.0, unit)
        numbers, at = _numbers(body, body.model, kind, place)
        value = scale = float(numbers[at])
        if kind in OF_JOINTS:
            typical = FRICTION * limits.torque[k]
            usual = {
                "armature": 0.1 * self._inertia(k),
                "damping": typical / limits.velocity[k],
                "frictionloss": typical,
            }[kind]
        elif kind.startswith("com"):
            # A centre at 0 has the size of the body, by its radius of gyration.
            b, scale = at[0], 0.0
            turning = body.model.body_inertia[b].mean() / max(body.model.body_mass[b], 1e-9)
            usual = max(np.sqrt(turning), np.linalg.norm(body.model.body_ipos[b]), 1e-3)
        else:
            usual = 1.0 if kind == "mass" else 1e-3
        return Parameter(kind, place, value, float(scale or usual), unit)

    def _inertia(self, k: int) -> float:
        """Return the inertia that joint ``k`` moves at home."""
        still = np.zeros((2, self.body.n))
        pushed = still.copy()
        pushed[1, k] = 1.0
        home = np.tile(self.body.home, (2, 1))
        torques = self.body.torques(Motion(1.0, home, still, pushed))
        return float(torques[1, k] - torques[0, k])

    def regressor(self, motion: Motion, rigid: Array | None = None) -> Array:
        """Return ∂τ/∂p in relative units, (T, n, p): torque for a parameter off by its scale.

        ``rigid`` is the regressor of the body, where it is known already.
        """
        body, model = self.body, self.body.model
        result = np.zeros((len(motion.positions), body.n, len(self)))
        of_bodies = [i for i, one in enumerate(self.parameters) if one.kind not in OF_JOINTS]
        needs_torques = any(one.kind == "gear" for one in self.parameters)
        if of_bodies or needs_torques:
            rows = body.regressor(motion) if rigid is None else rigid
            result[:, :, of_bodies] = rows @ self._directions
        signs = np.tanh(motion.velocities / (SLOW * self.limits.velocity))
        parts = {"armature": motion.accelerations, "damping": motion.velocities}
        parts["frictionloss"] = signs
        if needs_torques:
            friction = model.dof_damping[body.dofs] * motion.velocities
            friction += model.dof_frictionloss[body.dofs] * signs
            parts["gear"] = -(body.torques(motion, rows) + friction)
        for i, one in enumerate(self.parameters):
            if one.kind in OF_JOINTS:
                k = body.joints.index(one.place)
                result[:, k, i] = parts[one.kind][:, k]
        return np.asarray(result * self.scales)

    def _inertial_directions(self) -> Array:
        """Return derivatives of the inertial parameters by unknowns of bodies, (10 · bodies, k).

        They are of the second degree at most, of which central differences are exact.
        """
        body, model = self.body, copy.copy(self.body.model)
        columns = []
        for one in self.parameters:
            if one.kind in OF_JOINTS:
                continue
            numbers, at = _numbers(body, model, one.kind, one.place)
            value, ends = float(numbers[at]), []
            for step in (one.scale, -one.scale):
                numbers[at] = value + step
                ends.append(inertial(model, body.moved))
            numbers[at] = value
            columns.append((ends[0] - ends[1]) / (2.0 * one.scale))
        return np.array(columns).reshape(-1, body.inertial.size).T

    def information(self, motion: Motion, rate: float, rigid: Array | None = None) -> Array:
        """Return the information of a motion in relative units, (p, p).

        Parameters
        ----------
        motion : Motion
        rate : float
            Independent measurements of each torque in a second [Hz].
        """
        flat = self.weighted(motion, rate, rigid).reshape(-1, len(self))
        return flat.T @ flat

    def weighted(self, motion: Motion, rate: float, rigid: Array | None = None) -> Array:
        """Return the regressor in units of the noise, (T, n, p), as of ``rate`` rows a second."""
        scales = np.sqrt(rate * motion.dt) / (self.noise * self.limits.torque)
        return np.asarray(self.regressor(motion, rigid) * scales[:, None])


def _numbers(body: Body, model: Any, kind: str, place: str) -> tuple[Array, tuple[int, ...]]:
    """Return the numbers of a model among which a parameter is, and where; gears are in none."""
    if kind in OF_JOINTS:
        return getattr(model, f"dof_{kind}"), (body.dofs[body.joints.index(place)],)
    b = body.moved[body.bodies.index(place)]
    if kind == "mass":
        return model.body_mass, (b,)
    numbers = model.body_ipos if kind.startswith("com") else model.body_inertia
    return numbers, (b, "xyz".index(kind[-1]))


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """Expected errors of the parameters by a motion, and combinations without effect.

    Attributes
    ----------
    null : list of str
        Combinations that no motion of this kind changes, in words.
    weak : list of str
        Parameters whose standard error without a prior is above ``WEAK`` of their size.
    """

    null: list[str]
    weak: list[str]

    @classmethod
    def of(cls, unknowns: Unknowns, motion: Motion, rate: float) -> Identifiability:
        """Examine a motion, of which each torque is measured at a rate [Hz]."""
        rows = unknowns.weighted(motion, rate).reshape(-1, len(unknowns))
        null, alone, sizes = _null_space(rows)
        basis = _sparse(null)
        touched = np.abs(basis).max(axis=0, initial=0.0) > 0.0
        weak = [
            f"{one.name} ({100.0 * error:.0f} %)"
            for one, error, is_null in zip(unknowns.parameters, alone, touched, strict=True)
            if error > WEAK and not is_null
        ]
        return cls([_words(row / sizes, unknowns) for row in basis], weak)


def count_null(unknowns: Unknowns, motion: Motion) -> int:
    """Return how many combinations of the parameters a motion does not change."""
    return len(_null_space(unknowns.weighted(motion, 1.0).reshape(-1, len(unknowns)))[0])


def _null_space(rows: Array) -> tuple[Array, Array, Array]:
    """Return the combinations that rows (N, p) do not see, (k, p), errors of the rest, and sizes.

    The parts of a combination are multiplied by the sizes of their columns, (p,), or 1 for 0: what
    counts is their effect.
    """
    sizes = np.linalg.norm(rows, axis=0)
    dead = sizes <= NULL * sizes.max()  # of columns that rounding alone fills
    sizes[dead] = np.inf
    _, values, vectors = np.linalg.svd(np.linalg.qr(rows / sizes, mode="r"))
    sizes[dead] = 1.0
    lost = values <= NULL * values[0]
    alone = np.linalg.norm(vectors[~lost].T / values[~lost], axis=1) / sizes
    return vectors[lost], alone, sizes


def relative_errors(information: Array) -> Array:
    """Return standard errors with a prior of standard deviation 1, (p,)."""
    covariance = np.linalg.inv(information + np.eye(len(information)))
    return np.sqrt(np.diag(covariance))


def _sparse(rows: Array) -> Array:
    """Return a basis of the space of some rows, (k, p), that has few parts other than 0.

    Each vector of it is alone to have a part at its pivot; then multiples of others are taken from
    it for as long as that leaves fewer parts.
    """
    k, fewer = len(rows), True
    if not k:
        return rows
    pivots = scipy.linalg.qr(rows, mode="r", pivoting=True)[1][:k]
    basis = _rounded(np.array(np.linalg.solve(rows[:, pivots], rows), dtype=float))
    while fewer:
        fewer = False
        for i, j in itertools.permutations(range(k), 2):
            for at in np.flatnonzero(basis[i] * basis[j]):
                one = _rounded(basis[i] - basis[i, at] / basis[j, at] * basis[j])
                if np.count_nonzero(one) < np.count_nonzero(basis[i]):
                    basis[i], fewer = one, True
    return basis[np.argsort(np.count_nonzero(basis, axis=1), kind="stable")]


def _rounded(rows: Array) -> Array:
    """Return combinations without parts that are small beside their largest one."""
    sizes = np.abs(rows)
    return np.where(sizes > SMALL * sizes.max(axis=-1, keepdims=True), rows, 0.0)


def _words(row: Array, unknowns: Unknowns) -> str:
    """Return a null direction in words: what cannot be told apart."""
    parts = [i for i in np.argsort(-np.abs(row), kind="stable") if row[i]]
    if len(parts) == 1:
        return f"{unknowns.names[parts[0]]} has no effect"
    shown = unknowns.scales * row
    unit = abs(shown[parts[0]]) * np.sign(shown[min(parts)])
    named = [f"{_times(shown[i] / unit)}{unknowns.names[i]}" for i in sorted(parts)]
    text = " + ".join(named[:_SHOWN]).replace("+ −", "− ")
    more = f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else ""
    return f"{text}{more}"


_SHOWN = 6


def _times(factor: float) -> str:
    text = f"{abs(factor):.3g}"
    sign = "−" if factor < 0 else ""
    return sign if text == "1" else f"{sign}{text} · "
