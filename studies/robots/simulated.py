"""Robot in simulation whose friction is hidden, and the arms of the study with their limits."""

from __future__ import annotations

import copy
import dataclasses
import importlib.util
import math
from pathlib import Path

import mujoco
import numpy as np

from dopt.robots.body import Body, hang, point
from dopt.robots.limits import Limits
from dopt.types import Array

CONTROL = 0.002
"""Seconds from one torque to the next: 500 Hz."""

FINER = 4
"""Steps of the engine in a period of control."""

SMOOTH = 0.002
"""Width in which dry friction changes its sign, as a part of the velocity limit."""

ROTOR = 0.0025
"""Armature of the iiwa [kg m²] by N m of the torque limit, which its URDF leaves out.

It makes 0.1 kg m² of the wrist, as in MuJoCo Menagerie's iiwa 14, and more of larger drives."""


@dataclasses.dataclass(frozen=True)
class Friction:
    """Friction of n joints: f(v) = (F_c + F_s exp(-(v/w)²)) tanh(v/v₀) + F_v v.

    Reference: B. Armstrong-Hélouvry, P. Dupont and C. Canudas de Wit, Automatica 30, 7 (1994).

    Attributes
    ----------
    coulomb, viscous, stribeck, width, smooth : (n,)
        F_c [N m], F_v [N m s], F_s [N m], w and v₀ [rad/s].
    """

    coulomb: Array
    viscous: Array
    stribeck: Array
    width: Array
    smooth: Array

    @classmethod
    def drawn(cls, limits: Limits, random: np.random.Generator) -> Friction:
        """Draw 2–6 % of the torque limit as Coulomb, 1–5 % as viscous friction at full velocity.

        The Stribeck height is 0–40 % of Coulomb friction, its width 1–6 % of the velocity limit.
        """
        n = len(limits.torque)
        coulomb = random.uniform(0.02, 0.06, n) * limits.torque
        viscous = random.uniform(0.01, 0.05, n) * limits.torque / limits.velocity
        stribeck = random.uniform(0.0, 0.4, n) * coulomb
        width = random.uniform(0.01, 0.06, n) * limits.velocity
        return cls(coulomb, viscous, stribeck, width, SMOOTH * limits.velocity)

    def torques(self, velocities: Array) -> Array:
        """Return friction torques, (..., n), at velocities (..., n)."""
        dry = self.coulomb + self.stribeck * np.exp(-((velocities / self.width) ** 2))
        result: Array = dry * np.tanh(velocities / self.smooth) + self.viscous * velocities
        return result

    def implicit(self, velocities: Array) -> tuple[Array, Array]:
        """Return b and d ≥ 0, (n,), with f ≈ b + d v' for the velocity v' after a short step.

        A tangent where friction is smooth; near rest a chord through zero, which does not chatter.
        """
        v, near = velocities, np.abs(velocities) < 5.0 * self.smooth
        f = self.torques(v)
        chord = f / np.where(np.abs(v) < 1e-9, 1e-9, v)
        chord = np.where(np.abs(v) < 1e-9, (self.coulomb + self.stribeck) / self.smooth, chord)
        d = np.where(near, chord, self.viscous)
        return f - d * v, d


class SimulatedRobot:
    """Robot in MuJoCo with hidden friction, noisy torques and encoders, at 500 Hz.

    Contacts, limits of joints, and the friction and damping of the file are off. Friction enters
    the implicit integration as damping, with four steps of the engine in a period of control.

    Parameters
    ----------
    body : Body
        All joints have to be driven.
    limits : Limits
        Sizes of friction and of noise.
    seed : int
    friction : Friction, optional
        Drawn from the seed if it is left out.
    noise : float
        Standard deviation of white noise of the torque, as a part of the torque limit.
    ripple : float
        Amplitude of a sinusoid in the position, of 10 to 40 periods a turn, of the same unit.
    counts : int
        Steps of an encoder in a turn; 0 measures exactly.
    payload : (float, float), optional
        Time [s] from which a mass [kg] hangs on the last moved body.
    """

    def __init__(
        self,
        body: Body,
        limits: Limits,
        seed: int,
        friction: Friction | None = None,
        noise: float = 0.01,
        ripple: float = 0.005,
        counts: int = 2**16,
        payload: tuple[float, float] | None = None,
    ) -> None:
        if body.n != body.model.nv:
            raise ValueError(f"{body.n} of {body.model.nv} joints are driven, all are expected")
        random = np.random.default_rng(seed)
        self.body, self.limits = body, limits
        drawn = Friction.drawn(limits, random)
        self.friction = friction or drawn
        self._sizes = noise * limits.torque, ripple * limits.torque
        self._periods = random.integers(10, 41, body.n).astype(float)
        self._phases = random.uniform(0.0, 2.0 * np.pi, body.n)
        self._random, self._step = random, 2.0 * np.pi / counts if counts else 0.0
        self._payload = payload
        self._model = copy.copy(body.model)
        self._model.opt.timestep = CONTROL / FINER
        self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._model.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        )
        self._model.dof_damping[:] = 0.0
        self._model.dof_frictionloss[:] = 0.0
        self._data = mujoco.MjData(self._model)
        self._data.qpos[body.addresses] = np.clip(body.home, *limits.position.T)
        away = (self.q < limits.position.T[0] + 0.05) | (self.q > limits.position.T[1] - 0.05)
        self._data.qpos[body.addresses] = np.where(away, limits.middle, self.q)

    @property
    def q(self) -> Array:
        """True positions, (n,)."""
        return np.array(self._data.qpos[self.body.addresses])

    @property
    def v(self) -> Array:
        """True velocities, (n,)."""
        return np.array(self._data.qvel[self.body.dofs])

    @property
    def time(self) -> float:
        return float(self._data.time)

    def place(self, q: Array) -> None:
        """Put the robot at rest at a position, (n,)."""
        self._data.qpos[self.body.addresses] = q
        self._data.qvel[:] = 0.0

    def state(self) -> tuple[Array, float]:
        """Return positions by the encoders, (n,), and the time [s]."""
        return (np.round(self.q / self._step) * self._step if self._step else self.q), self.time

    def step(self, torque: Array) -> None:
        """Apply torques, (n,), for one period of control."""
        if self._payload and self.time >= self._payload[0]:
            self._take(self._payload[1])
            self._payload = None
        noise, ripple = self._sizes
        data, dofs = self._data, self.body.dofs
        applied = np.clip(torque, -self.limits.torque, self.limits.torque)
        applied = applied + noise * self._random.standard_normal(self.body.n)
        applied += ripple * np.sin(self._periods * self.q + self._phases)
        for _ in range(FINER):
            constant, damping = self.friction.implicit(data.qvel[dofs])
            self._model.dof_damping[dofs] = damping
            data.qfrc_applied[dofs] = applied - constant
            mujoco.mj_step(self._model, data)

    def _take(self, mass: float) -> None:
        """Hang a ball of 4 cm on the last moved body, 8 cm before its centre of mass."""
        hang(self._model, self.body.moved[-1], self.ball(mass))

    def ball(self, mass: float) -> Array:
        """Return the inertial parameters of the ball, (10,)."""
        centre = self.body.model.body_ipos[self.body.moved[-1]]
        reach = 0.08 * np.array([0.5, 0.0, math.sqrt(0.75)])
        own = 0.4 * mass * 0.04**2 * np.repeat([0.0, 1.0, 0.0], [4, 3, 3])
        return point(mass, mass * (centre + reach)) + own


LIMITS = Path(__file__).with_name("iiwa.yaml")


def iiwa(urdf: Path, limits: Path) -> tuple[Body, Limits]:
    """Return KUKA's iiwa 7, by the URDF of pybullet with rotors, and a file of its true limits."""
    body = Body.load(urdf)
    known = Limits.of(body, limits)
    body.model.dof_armature[body.dofs] = ROTOR * known.torque
    return body, known


def jaco() -> tuple[Body, Limits]:
    """Return Kinova's Jaco arm by dm_control; velocities and torques of its data sheet.

    Accelerations are what the torques leave with the armature in the file.
    """
    spec = importlib.util.find_spec("dm_control")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("the Jaco arm needs dm_control: pip install dm-control")
    body = Body.load(Path(spec.origin).parent / "third_party/kinova/jaco_arm.xml")
    large = np.array([True, True, True, False, False, False])
    ranges = np.where(
        body.model.jnt_limited[:, None].astype(bool), body.model.jnt_range, [[-3.0, 3.0]]
    )
    return body, Limits(
        position=ranges,
        velocity=np.deg2rad(np.where(large, 36.0, 48.0)),
        acceleration=np.where(large, 3.0, 2.0),
        torque=np.where(large, 30.5, 6.8),
    )


__all__ = ["CONTROL", "LIMITS", "Friction", "SimulatedRobot", "iiwa", "jaco"]
