"""Rigid body of a robot from MJCF or URDF: its joints, its torques, and how they depend on it.

Motions are arrays over time: positions, velocities and accelerations of the n driven joints, each
(T, n), in rad or m, and torques (T, n), in N m or N.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from dopt.errors import SpecificationError, given_path, install_command
from dopt.systems.mujoco import log_warnings
from dopt.types import Array

if TYPE_CHECKING:
    import mujoco

BOUNDS = '<mujoco><compiler balanceinertia="true" boundmass="1e-4" boundinertia="1e-6"/></mujoco>'
"""Settings with which an URDF is read whose inertias no rigid body can have."""

PACKAGE = "package://"
"""Beginning of the files of a ROS package."""

UNREAD = "error opening file", "resource", "decoder", "mesh"
"""Parts of the engine's messages about meshes that are not there, or in a format such as .dae."""

DEEPER, ANYWHERE = 0.005, 200
"""Metres by which bodies that touch at home may come deeper, and random positions looked at."""

INERTIAL = 10
"""Inertial parameters of a body: m, m c (3), and Ixx, Iyy, Izz, Ixy, Ixz, Iyz about its origin."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """Motion of the driven joints at even times.

    Attributes
    ----------
    dt : float
        Time from one row to the next [s].
    positions, velocities, accelerations : (T, n)
    """

    dt: float
    positions: Array
    velocities: Array
    accelerations: Array

    @property
    def times(self) -> Array:
        """Time of each row, (T,) [s]."""
        return self.dt * np.arange(len(self.positions), dtype=float)

    def every(self, step: int) -> Motion:
        """Return every ``step``-th row."""
        rows = slice(None, None, step)
        parts = (self.positions[rows], self.velocities[rows], self.accelerations[rows])
        return Motion(self.dt * step, *parts)


class Body:
    """Rigid body of a robot, read from an MJCF or URDF file.

    Driven joints are hinges and slides that an actuator moves, or all hinges and slides where the
    file has no actuators, as in URDF, except those that a constraint couples to another. Other
    joints stay where the file puts them. Contacts and constraints produce no torque here;
    :attr:`notes` says what was left out.

    Parameters
    ----------
    model : mujoco.MjModel
    source : Path, optional
        The file, from which an URDF's limits of velocity are read.
    lost : sequence of str
        Meshes of the file that the model lacks.

    Attributes
    ----------
    joints : tuple of str
        Names of the n driven joints.
    bodies : tuple of str
        Names of the bodies that a driven joint moves.
    """

    def __init__(
        self, model: mujoco.MjModel, source: Path | None = None, lost: Sequence[str] = ()
    ) -> None:
        import mujoco

        log_warnings()
        self.model, self.source, self._lost = _effective(model), source, list(lost)
        self._ids = _driven_joints(model)
        if not self._ids:
            raise SpecificationError(
                "the robot has no hinge or slide that can be driven, but at least one is expected: "
                "give an MJCF or URDF file of an arm."
            )
        self.dofs = model.jnt_dofadr[self._ids]
        self.addresses = model.jnt_qposadr[self._ids]
        self.joints = tuple(_name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in self._ids)
        self._paths = _paths(model, self._ids)
        if closed := _closed(model, self._ids, self._paths):
            raise SpecificationError(
                f"the constraint {listed(closed)} ties bodies or joints that actuators move apart, "
                f"but a robot without closed loops is expected: take it from the file, or the "
                f"actuators that move what it ties."
            )
        self.moved = tuple(b for b in range(1, model.nbody) if self._paths[b])
        self.bodies = tuple(_name(model, mujoco.mjtObj.mjOBJ_BODY, b) for b in self.moved)

    @classmethod
    def load(cls, file: str | Path) -> Body:
        """Read a file, .xml (MJCF) or .urdf; meshes that are not there are left out.

        Those of a ROS package, package://NAME/FILE, are looked for in the folders above the file.

        Raises
        ------
        SpecificationError
            If MuJoCo is not installed, or the file cannot be read or describes no arm.
        """
        source = given_path(str(file), "the file of a robot", SpecificationError)
        if not source.is_file():
            raise SpecificationError(
                f"there is no file {source}, but a robot in MJCF or URDF is expected: correct it."
            )
        try:
            log_warnings()
            _, model, lost = specification(source)
        except ModuleNotFoundError as error:
            raise SpecificationError(
                f"a robot needs MuJoCo, which is not installed: {install_command('mujoco')}."
            ) from error
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split())
            bounded = "inertia" in text and "eigenvalues" not in text
            urdf = bounded and b"<robot" in source.read_bytes()
            remedy = f"put {BOUNDS} into its <robot>" if urdf else "correct it"
            if b"<xacro:" in source.read_bytes() and "inertia" not in text and "mesh" not in text:
                remedy = f"expand it (xacro {source.name} > robot.urdf)"
            raise SpecificationError(
                f"{source} cannot be read ({text}), but a robot in MJCF or URDF is expected: "
                f"{remedy}."
            ) from error
        return cls(model, source, lost)

    @functools.cached_property
    def notes(self) -> tuple[str, ...]:
        """Parts of the model that torques, or searches for collisions, leave out."""
        lost = f"left out: meshes and their contacts, for one cannot be read: {listed(self._lost)}"
        left = _left_out(self.model, self._ids)
        return (*[lost][: len(self._lost)], *left, *self._contacts.left_out())

    @property
    def n(self) -> int:
        """Number of driven joints."""
        return len(self._ids)

    @property
    def units(self) -> list[str]:
        """Units of the torques, "N m" or "N"."""
        return ["N" if kind == SLIDE else "N m" for kind in self.model.jnt_type[self._ids]]

    @property
    def inertial(self) -> Array:
        """Inertial parameters of the moved bodies, (10 · bodies,)."""
        return inertial(self.model, self.moved)

    @property
    def home(self) -> Array:
        """Positions of the driven joints in the file, or in its first keyframe, (n,).

        A joint that is out of its range there is in the middle of it.
        """
        model = self.model
        positions = (model.key_qpos[0] if model.nkey else model.qpos0)[self.addresses]
        low, high = model.jnt_range[self._ids].T
        outside = model.jnt_limited[self._ids] & ((positions < low) | (positions > high))
        return np.asarray(np.where(outside, (low + high) / 2.0, positions))

    @property
    def ranges(self) -> Array:
        """Ranges of the driven joints in the file, (n, 2); without any, a turn or a metre."""
        limited = self.model.jnt_limited[self._ids].astype(bool)
        free = np.where(self.model.jnt_type[self._ids] == HINGE, np.pi, 0.5)
        around = self.home[:, None] + free[:, None] * [-1.0, 1.0]
        return np.asarray(np.where(limited[:, None], self.model.jnt_range[self._ids], around))

    def regressor(self, motion: Motion) -> Array:
        """Return how torques depend on the inertial parameters, (T, n, 10 · bodies).

        A body of pose H and pseudo-inertia J takes the torques tr(∂H/∂q J (Ḧ - G)ᵀ), with gravity
        G, all (4, 4): J. J. Uicker, J. Applied Mechanics 34, 2 (1967); P. M. Wensing, S. Kim and
        J.-J. E. Slotine, IEEE Robotics and Automation Letters 3, 1 (2018).
        """
        result = np.zeros((len(motion.positions), self.n, len(self.moved), INERTIAL))
        frames, gravity = self._frames(motion), np.zeros((4, 4))
        for i, b in enumerate(self.moved):
            _, _, bent, slopes = frames[b]
            gravity[:3, 3] = self.model.opt.gravity * (1.0 - self.model.body_gravcomp[b])
            pairs = np.swapaxes(slopes, 2, 3) @ (bent - gravity)[:, None]
            result[:, self._paths[b], i] = pairs.reshape(*pairs.shape[:2], 16) @ PSEUDO
        return result.reshape(*result.shape[:2], -1)

    def torques(self, motion: Motion, regressor: Array | None = None) -> Array:
        """Return the torques that move the body, without friction, (T, n).

        Includes armature, springs, tendons and fluids, as the file gives them. The regressor of
        the motion, where it is known already, saves time.
        """
        model = self.model
        if model.jnt_stiffness.any() or model.ntendon or model.opt.density or model.opt.viscosity:
            states = zip(motion.positions, motion.velocities, motion.accelerations, strict=True)
            return np.array([self._known.inverse(*state) for state in states])
        rows = self.regressor(motion) if regressor is None else regressor
        rotors = model.dof_armature[self.dofs] * motion.accelerations
        return np.asarray(rows @ self.inertial + rotors)

    def columns(self, motion: Motion) -> dict[str, Array]:
        """Return time, q, dq, ddq and tau of each joint, such as ``q_elbow``, each (T,).

        Torques tau are without friction, as by :meth:`torques`.
        """
        parts = {"q": motion.positions, "dq": motion.velocities, "ddq": motion.accelerations}
        parts["tau"] = self.torques(motion)
        named = {
            f"{kind}_{joint}": part[:, j]
            for kind, part in parts.items()
            for j, joint in enumerate(self.joints)
        }
        return {"time": motion.times, **named}

    @functools.cached_property
    def _known(self) -> KnownBody:
        return KnownBody(self)

    def _frames(self, motion: Motion) -> list[tuple[Array, ...]]:
        """Return H, Ḣ, Ḧ, each (T, 4, 4), and ∂H/∂q by the joints that move it, of each body.

        H turns homogeneous coordinates in the body into those in the world.
        """
        model, t = self.model, len(motion.positions)
        still = np.zeros((t, 4, 4))
        frames: list[tuple[Array, ...]] = [
            (np.tile(np.eye(4), (t, 1, 1)), still, still, still[:, None][:, :0])
        ]
        for b in range(1, model.nbody):
            fixed = np.eye(4)
            fixed[:3, :3], fixed[:3, 3] = rotation(model.body_quat[b]), model.body_pos[b]
            pose, rate, bent, slopes = (part @ fixed for part in frames[model.body_parentid[b]])
            for k in self._paths[b][slopes.shape[1] :]:
                j = self._ids[k]
                twist, hinge = _twist(model, j), model.jnt_type[j] == HINGE
                x = motion.positions[:, k, None, None] - model.qpos0[self.addresses[k]]
                v, a = (one[:, k, None, None] for one in (motion.velocities, motion.accelerations))
                around = np.sin(x) * twist + (1.0 - np.cos(x)) * (twist @ twist)
                moved = np.eye(4) + (around if hinge else x * twist)
                pose, rate, bent = (part @ moved for part in (pose, rate, bent))
                slope = pose @ twist
                bent = bent + 2.0 * v * (rate @ twist) + a * slope + v**2 * (slope @ twist)
                rate = rate + v * slope
                slopes = np.concatenate([slopes @ moved[:, None], slope[:, None]], axis=1)
            frames.append((pose, rate, bent, slopes))
        return frames

    def collisions(self, positions: Array) -> list[tuple[int, str, str]]:
        """Return where bodies touch that do not at home, or deeper: row, and the two bodies' names.

        Parameters
        ----------
        positions : (T, n)
        """
        import mujoco

        return [
            (row, *(_name(self.model, mujoco.mjtObj.mjOBJ_BODY, b) for b in pair))  # type: ignore[misc]  # names are two
            for row, q in enumerate(positions)
            for pair in sorted(self._contacts.near(q))
        ]

    @functools.cached_property
    def _contacts(self) -> Contacts:
        return Contacts(self)


class KnownBody:
    """Inverse dynamics of a body at 500 Hz, without friction, contacts and limits.

    Joints that are not driven stay at rest.
    """

    def __init__(self, body: Body) -> None:
        import mujoco

        self.body, self.model, self._engine = body, copy.copy(body.model), mujoco
        self.model.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        )
        self.model.dof_damping[:] = 0.0
        self.model.dof_frictionloss[:] = 0.0
        if hasattr(self.model, "dof_dampingpoly"):
            self.model.dof_dampingpoly[:] = 0.0
        self._data = mujoco.MjData(self.model)

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torques [N m], (n,), that accelerate the body so."""
        data, dofs = self._data, self.body.dofs
        data.qpos[self.body.addresses] = q
        data.qvel[dofs] = v
        data.qacc[dofs] = a
        self._engine.mj_inverse(self.model, data)
        return np.array(data.qfrc_inverse[dofs])

    def mass_matrix(self) -> Array:
        """Return M, (n, n), at the position of the last call of :meth:`inverse`."""
        dofs = self.body.dofs
        M = np.zeros((len(dofs), self.model.nv))
        for column, unit in zip(M, np.eye(self.model.nv)[dofs], strict=True):
            self._engine.mj_mulM(self.model, self._data, column, unit)
        return M[:, dofs]

    def apparent_inertia(self) -> Array:
        """Return the inertia of each joint while the others are free, (n,), where M is."""
        return 1.0 / np.diag(np.linalg.inv(self.mass_matrix()))


class Contacts:
    """Pairs of bodies that come near each other.

    Those that touch at home may touch as deep; those that touch everywhere are left out.

    Parameters
    ----------
    body : Body
    apart : float
        Distance that they are to keep [m]; half of the one at home, where that is less.
    seen : float
        Distance from which they are looked at [m]; 0 finds contacts alone.
    """

    def __init__(self, body: Body, apart: float = 0.0, seen: float = 0.0) -> None:
        import mujoco

        self._body, self._engine, self._free = body, mujoco, seen - apart
        self._model = model = copy.copy(body.model) if seen else body.model
        if seen:
            model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_OVERRIDE
            model.opt.o_margin = seen
        self._data = mujoco.MjData(model)
        moved = list(body.moved)
        self._kept = np.full((model.nbody, model.nbody), -np.inf)
        self._kept[moved] = self._kept[:, moved] = apart
        pairs, distances = self._pass(body.home)
        deeper = np.minimum(distances, 0.0) - (0.2 * DEEPER if seen else DEEPER)
        at_home = np.where((distances > 0.0) & (seen > 0.0), 0.5 * distances, deeper)
        for a, b in (pairs.T, pairs.T[::-1]):
            np.minimum.at(self._kept, (a, b), at_home)
        self.touching = self._touching(body.home)
        self.always = set(self.touching)
        for q in poses(body.ranges, ANYWHERE * bool(self.always)):
            self.always &= self._touching(q)
        for a, b in self.always:
            self._kept[a, b] = self._kept[b, a] = -np.inf

    def _pass(self, positions: Array) -> tuple[npt.NDArray[np.int32], Array]:
        """Return the bodies of each contact, (k, 2), and their distances, (k,) [m]."""
        data = self._data
        data.qpos[self._body.addresses] = positions
        self._engine.mj_kinematics(self._model, data)
        self._engine.mj_comPos(self._model, data)
        self._engine.mj_collision(self._model, data)
        contact = data.contact
        return self._model.geom_bodyid[contact.geom], np.array(contact.dist)

    def _touching(self, positions: Array) -> set[tuple[int, int]]:
        """Return the pairs with a moved body that touch at positions, (n,)."""
        pairs, distances = self._pass(positions)
        touching = {(min(pair), max(pair)) for pair in pairs[distances <= 0.0].tolist()}
        return {pair for pair in touching if {*pair} & {*self._body.moved}}

    def left_out(self) -> list[str]:
        """Name the bodies that touch at home, of which contacts are not counted, or deeper ones."""
        deeper = f"contacts less than {1e3 * DEEPER:g} mm deeper than where the file puts them"
        always = "contacts of bodies that touch in all positions"
        said = ((always, self.always), (deeper, self.touching - self.always))
        kind = self._engine.mjtObj.mjOBJ_BODY
        return [
            f"left out: {what}: "
            + listed([" and ".join(_name(self._model, kind, b) for b in p) for p in sorted(pairs)])
            for what, pairs in said
            if pairs
        ]

    def near(self, positions: Array) -> set[tuple[int, int]]:
        """Return the pairs that the engine finds in contact at positions, (n,)."""
        pairs, distances = self._pass(positions)
        kept = self._kept[pairs[:, 0], pairs[:, 1]]
        counted = (kept >= 0.0) | (distances < kept)
        return {(min(pair), max(pair)) for pair in pairs[counted].tolist()}

    def room(self, positions: Array) -> float:
        """Return how far the nearest pair is beyond the distance to keep [m], negative within."""
        pairs, distances = self._pass(positions)
        room = distances - self._kept[pairs[:, 0], pairs[:, 1]]
        return float(room.min(initial=self._free))

    def levers(self, limits: Array) -> Array:
        """Return how far a unit of each joint moves any geom [m], (n,).

        The largest over 200 random positions within limits, (n, 2).
        """
        model = self._model
        reach, turns = np.zeros(model.nv), np.zeros((2, 3, model.nv))
        for q in poses(limits, 200):
            self._pass(q)
            for geom, radius in enumerate(model.geom_rbound):
                self._engine.mj_jacGeom(model, self._data, *turns, geom)
                sizes = np.linalg.norm(turns, axis=1)
                reach = np.maximum(reach, sizes[0] + radius * sizes[1])
        return np.asarray(reach[self._body.dofs])


HINGE, SLIDE = 3, 2
"""Types of joints of MuJoCo."""


def poses(ranges: Array, count: int) -> Array:
    """Return random positions, (count, n), within ranges, (n, 2): always the same."""
    low, high = ranges.T
    return np.asarray(low + (high - low) * np.random.default_rng(0).random((count, len(ranges))))


def inertial(model: mujoco.MjModel, bodies: Sequence[int]) -> Array:
    """Return the inertial parameters of some bodies of a model, (10 · bodies,)."""
    rows = []
    for b in bodies:
        m, c, axes = model.body_mass[b], model.body_ipos[b], rotation(model.body_iquat[b])
        about_com = axes @ np.diag(model.body_inertia[b]) @ axes.T
        about = about_com + m * (c @ c * np.eye(3) - np.outer(c, c))
        rows.append([m, *(m * c), *np.diag(about), *about[np.triu_indices(3, 1)]])
    return np.concatenate(rows)


def point(mass: float, moment: Array, least: float = 0.0) -> Array:
    """Return the inertial parameters of a point mass, (10,), by its first moment, (3,).

    Its inertia is by a mass of the magnitude ``least`` where it has less.
    """
    spread = moment @ moment * np.eye(3) - np.outer(moment, moment)
    about = spread / np.copysign(max(abs(mass), least), mass)
    return np.array([mass, *moment, *np.diag(about), *about[np.triu_indices(3, 1)]])


def hang(model: mujoco.MjModel, b: int, added: Array) -> None:
    """Add inertial parameters, (10,), to a body of a model; without mass, it stays as it is.

    Its centre comes no farther than its radius of gyration, as of estimates that do not fit.
    """
    m, *rest = inertial(model, [b]) + added
    if m <= 0.0:
        return
    c, (x, y, z) = np.array(rest[:3]) / m, rest[6:]
    reach = np.sqrt(max(sum(rest[3:6]), 0.0) / (2.0 * m))
    c *= min(1.0, reach / max(float(np.linalg.norm(c)), 1e-12))
    about = np.diag(rest[3:6]) + np.array([[0.0, x, y], [x, 0.0, z], [y, z, 0.0]])
    moments, axes = np.linalg.eigh(about - m * (c @ c * np.eye(3) - np.outer(c, c)))
    model.body_mass[b], model.body_ipos[b] = m, c
    model.body_inertia[b] = np.maximum(moments, 0.01 * model.body_inertia[b].min())
    turn = Rotation.from_matrix(np.linalg.det(axes) * axes)
    model.body_iquat[b] = turn.as_quat(scalar_first=True)
    settle(model)


def settle(model: mujoco.MjModel) -> None:
    """Let a model take changed inertias: no short cuts for centres at 0 and constant ones."""
    import mujoco

    model.body_sameframe[:] = model.body_simple[:] = model.dof_simplenum[:] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _pseudo_inertias() -> Array:
    """Return the entries of a pseudo-inertia by the inertial parameters, (16, 10).

    It holds the second moments tr(I)/2 - I, the first moments m c, and the mass.
    """
    result = np.zeros((4, 4, INERTIAL))
    result[3, 3, 0] = 1.0
    for i in range(3):
        result[i, 3, 1 + i] = result[3, i, 1 + i] = 1.0
        result[i, i, 4:7] = 0.5 - np.eye(3)[i]
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), start=7):
        result[i, j, k] = result[j, i, k] = -1.0
    return result.reshape(16, INERTIAL)


PSEUDO = _pseudo_inertias()
"""Entries of a pseudo-inertia, (16, 10), by :data:`INERTIAL` parameters."""


def _twist(model: mujoco.MjModel, j: int) -> Array:
    """Return the matrix B of a joint with ∂H/∂q = H B, (4, 4)."""
    axis, result = model.jnt_axis[j], np.zeros((4, 4))
    if model.jnt_type[j] == HINGE:
        result[:3, :3] = np.cross(np.eye(3), axis)
        axis = np.cross(model.jnt_pos[j], axis)
    result[:3, 3] = axis
    return result


def rotation(quaternion: Array) -> Array:
    """Return the rotation of a unit quaternion (w, x, y, z), (3, 3)."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def _effective(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy whose joints have what its flags and actuators change.

    Without gravity where it is disabled, and with the armature and the damping of actuators.
    Gravity that actuators compensate is a part of their torques.
    """
    import mujoco

    model = copy.copy(model)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        model.opt.gravity[:] = 0.0
    if model.jnt_actgravcomp.any():
        model.body_gravcomp[:] = 0.0
    for a, j, gear, _ in actuators(model) if hasattr(model, "actuator_armature") else ():
        dof = model.jnt_dofadr[j]
        model.dof_armature[dof] += gear**2 * model.actuator_armature[a]
        model.dof_damping[dof] += gear**2 * model.actuator_damping[a]
        model.actuator_armature[a] = model.actuator_damping[a] = 0.0
    return model


def actuators(model: mujoco.MjModel) -> Iterator[tuple[int, int, float, int]]:
    """Yield the actuators of hinges and slides: number, joint, gear and place of its control."""
    controls, outputs = (getattr(model, f"actuator_{kind}adr", None) for kind in ("ctrl", "out"))
    for a, (target, _) in enumerate(model.actuator_trnid):
        of_joint = model.actuator_trntype[a] in (0, 1)  # of a joint, or in its parent's frame
        if of_joint and model.jnt_type[target] in (HINGE, SLIDE):
            gear = float(model.actuator_gear[a if outputs is None else outputs[a], 0])
            yield a, int(target), gear, a if controls is None else int(controls[a])


def _driven_joints(model: mujoco.MjModel) -> list[int]:
    import mujoco

    by_joint = {j for _, j, _, _ in actuators(model)}
    active = model.eq_active0.astype(bool)
    coupled = model.eq_obj1id[active & (model.eq_type == mujoco.mjtEq.mjEQ_JOINT)]
    free = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
    return sorted(by_joint) or [j for j in free if j not in coupled]


def _paths(model: mujoco.MjModel, ids: list[int]) -> list[list[int]]:
    """Return the driven joints, by their places, that move each body."""
    paths: list[list[int]] = [[]]
    for b in range(1, model.nbody):
        own = [k for k, j in enumerate(ids) if model.jnt_bodyid[j] == b]
        paths.append([*paths[int(model.body_parentid[b])], *own])
    return paths


def _closed(model: mujoco.MjModel, ids: list[int], paths: list[list[int]]) -> list[str]:
    """Return the equality constraints that some motion of the driven joints alone breaks."""
    import mujoco

    kinds, objects, found = mujoco.mjtEq, mujoco.mjtObj, list[str]()
    for e in np.flatnonzero(model.eq_active0):
        ends, kind = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])], kinds(model.eq_type[e])
        of, tied = objects.mjOBJ_BODY, False
        if kind == kinds.mjEQ_JOINT:
            of, tied = objects.mjOBJ_JOINT, ends[0] in ids and ends[1] in [*ids, -1]
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            if model.eq_objtype[e] == objects.mjOBJ_SITE:
                ends = model.site_bodyid[ends].tolist()
            tied = paths[ends[0]] != paths[ends[1]]
        if tied:
            named = " and ".join(_name(model, of, i) for i in ends if i >= 0)
            name = _name(model, objects.mjOBJ_EQUALITY, int(e))
            found.append(f"{name} ({kind.name[5:].lower()} of {named})")
    return found


def _left_out(model: mujoco.MjModel, ids: list[int]) -> list[str]:
    import mujoco

    kinds = mujoco.mjtObj
    of_joints = [a for a, *_ in actuators(model)]
    bent = getattr(model, "dof_dampingpoly", np.zeros((model.nv, 1))).any(axis=1)
    carried = [j for j in ids if model.jnt_actgravcomp.any() > model.jnt_actgravcomp[j]]
    left = (
        ("joints taken to stay in their place", kinds.mjOBJ_JOINT, {*range(model.njnt)} - {*ids}),
        (
            "actuators that move no hinge or slide alone",
            kinds.mjOBJ_ACTUATOR,
            {*range(len(model.actuator_trntype))} - {*of_joints},
        ),
        ("equality constraints", kinds.mjOBJ_EQUALITY, range(model.neq)),
        ("dry friction of tendons", kinds.mjOBJ_TENDON, np.flatnonzero(model.tendon_frictionloss)),
        ("compensation of gravity of joints", kinds.mjOBJ_JOINT, carried),
        ("damping of higher order of joints", kinds.mjOBJ_JOINT, {*model.dof_jntid[bent]}),
    )
    return [
        f"left out: {what}: {listed([_name(model, kind, i) for i in sorted(which)])}"
        for what, kind, which in left
        if len(which)
    ]


def listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) < 4 else f"{names[0]} and {len(names) - 1} more"


def _name(model: mujoco.MjModel, kind: Any, i: int) -> str:
    import mujoco

    name = mujoco.mj_id2name(model, kind, int(i)) or f"{kind.name[6:].lower()}{i}"
    free = kind == mujoco.mjtObj.mjOBJ_JOINT and model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE
    return f"{name} (free)" if free else name


def specification(source: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """Return what a file says, its model, and the meshes that both lack, if one is not read."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(source))
    for mesh in spec.meshes:
        mesh.file = _located(source, mesh.file)
    try:
        return spec, spec.compile(), []
    except ValueError as error:
        if not any(word in str(error).lower() for word in UNREAD):
            raise
        missing = error
    spec = mujoco.MjSpec.from_file(str(source))
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    lost = [Path(mesh.file).name for mesh in spec.meshes]
    for part in [*spec.meshes, *spec.materials, *spec.textures]:
        spec.delete(part)
    try:
        return spec, spec.compile(), lost
    except ValueError as error:  # of a body whose mass the mesh gives, for one
        raise ValueError(f"{missing}; without meshes: {error}") from None


def _located(source: Path, file: str) -> str:
    """Return where a mesh package://NAME/FILE is: NAME is a folder above the robot's or beside it.

    The package may have another name there. Other files are returned as they are.
    """
    if not file.startswith(PACKAGE):
        return file
    _, *inside = parts = file.removeprefix(PACKAGE).split("/")
    places = (
        folder.joinpath(*path) for folder in source.resolve().parents for path in (parts, inside)
    )
    return next((str(place) for place in places if place.is_file()), file)
