"""The four plants as they are fitted, and as their authors publish them.

Constants have the units of the equations. A published plant is the same equation with the
published numbers, so that both are simulated alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dopt.systems.plant import Plant, encoder, unknown
from dopt.types import Array

G = 9.81
"""[m/s²]"""


def published(plant: Plant, constants: Mapping[str, float]) -> Plant:
    """Return a plant with numbers for its constants, 0 for those without one, and no delay."""
    numbers = {name: constants.get(name, 0.0) for name in plant.constants}
    return dataclasses.replace(plant, constants=numbers, delay=0.0)


DISK = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=0.025,
    gamma=3.0,
    known={
        "angle": "rate",
        "rate": "gain * voltage - damping * rate - gravity * sin(angle + offset)"
        " - coulomb * tanh(rate / 0.5) + bias",
    },
    constants={
        "gain": unknown(25.0),
        "damping": unknown(2.0),
        "gravity": unknown(100.0),
        "offset": unknown(0.0, spread=0.1),
        "coulomb": unknown(1.0, factor=3.0),
        "bias": unknown(0.0, spread=1.0),
    },
    learned=["rate"],
    angles=["angle"],
    box={"rate": 20.0},
    measured={"angle": encoder(2000)},
    delay=unknown(0.0, spread=0.025),
)
"""Motor with an eccentric mass; six constants and the delay."""

PENDULUM = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"torque": "N m"},
    dt=0.02,
    gamma=3.0,
    known={
        "angle": "rate",
        "rate": "(torque - gravity * sin(angle) - damping * rate - coulomb * tanh(rate / 0.1))"
        " / inertia",
    },
    constants={
        "inertia": unknown(0.15),
        "gravity": unknown(3.0),
        "damping": unknown(0.05, factor=3.0),
        "coulomb": unknown(0.1, factor=3.0),
    },
    learned=["rate"],
    angles=["angle"],
    box={"rate": 10.0},
    measured={"angle": 0.002},
)
"""Pendulum with a torque that is measured by the current of its motor."""

LEADERBOARD = {"inertia": 0.57288 * 0.5**2, "gravity": 0.57288 * G * 0.5}
LEADERBOARD |= {"damping": 0.1, "coulomb": 0.093}
"""Mass .57288 kg at .5 m, viscous friction .1 N m s/rad, dry friction .093 N m."""


def _two_joints(*, friction: str, bias: bool) -> dict[str, str]:
    """Return the equations of a double pendulum, angle 2 from link 1, both 0 when hanging."""
    slow = [f"(b{i} * rate{i} + c{i} * {friction.format(v=f'rate{i}')})" for i in (1, 2)]
    h = "a3 * sin(angle2)"
    far = "g2 * sin(angle1 + angle2)"
    r1 = f"(torque1 - g1 * sin(angle1) - {far} + {h} * (2 * rate1 + rate2) * rate2 - {slow[0]}"
    r2 = f"(torque2 - {far} - {h} * rate1 * rate1 - {slow[1]}"
    r1, r2 = (f"{r} + bias{i})" if bias else f"{r})" for i, r in ((1, r1), (2, r2)))
    m11, m12 = "(a1 + 2 * a3 * cos(angle2))", "(a2 + a3 * cos(angle2))"
    det = f"({m11} * m22 - {m12} * {m12})"
    return {
        "angle1": "rate1",
        "angle2": "rate2",
        "rate1": f"(m22 * {r1} - {m12} * {r2}) / {det}",
        "rate2": f"({m11} * {r2} - {m12} * {r1}) / {det}",
    }


_DESIGN = {"I1": 0.053470810264216295, "I2": 0.02392374528789766, "Ir": 7.659297952841183e-05}
_DESIGN |= {"l1": 0.3, "m1": 0.5593806151425046, "m2": 0.6043459469186889, "gear": 6.0}
_DESIGN |= {"r1": 0.3, "r2": 0.18377686083653508}


def _model_2(d: Mapping[str, float]) -> dict[str, float]:
    """Return the constants of the equations from the parameters of model_2.0 of design_A.0."""
    return {
        "a1": d["I1"] + d["I2"] + d["m2"] * d["l1"] ** 2 + (d["gear"] ** 2 + 1) * d["Ir"],
        "a2": d["I2"] - d["gear"] * d["Ir"],
        "a3": d["m2"] * d["l1"] * d["r2"],
        "m22": d["I2"] + d["gear"] ** 2 * d["Ir"],
        "g1": G * (d["m1"] * d["r1"] + d["m2"] * d["l1"]),
        "g2": G * d["m2"] * d["r2"],
        "b1": 0.001,
        "b2": 0.001,
        "c1": 0.093,
        "c2": 0.078,
    }


MODEL_2 = _model_2(_DESIGN)
"""model_2.0 of design_A.0, as its authors publish it."""

_ARCTAN = (
    "where({x} * {x} < 1, {x} / (1 + 0.28 * {x} * {x}),"
    " 1.5707963267948966 * sign({v}) - {x} / ({x} * {x} + 0.28))"
)
"""The authors' friction is c arctan(100 v); this is within .005 of the arctangent."""

DOUBLE_PENDULUM = Plant(
    states={"angle1": "rad", "angle2": "rad", "rate1": "rad/s", "rate2": "rad/s"},
    inputs={"torque1": "N m", "torque2": "N m"},
    dt=0.002,
    gamma=6.0,
    known=_two_joints(friction="tanh({v} / 0.1)", bias=True),
    constants={
        **{name: unknown(value) for name, value in MODEL_2.items() if name[0] in "amg"},
        **{name: unknown(0.01, factor=3.0) for name in ("b1", "b2")},
        **{name: unknown(0.1, factor=3.0) for name in ("c1", "c2")},
        **{name: unknown(0.0, spread=0.1) for name in ("bias1", "bias2")},
    },
    learned=["rate1", "rate2"],
    angles=["angle1", "angle2"],
    box={"rate1": 10.0, "rate2": 10.0},
    measured={"angle1": 0.001, "angle2": 0.001},
    delay=unknown(0.0, spread=0.002),
)
"""Both joints driven; twelve constants and the delay of the torques."""

MODEL_2_PLANT = dataclasses.replace(
    DOUBLE_PENDULUM,
    known=_two_joints(friction=f"({_ARCTAN})".replace("{x}", "(100 * {v})"), bias=False),
    constants=MODEL_2,
    delay=0.0,
)
"""model_2.0 with the friction of its authors."""


def _rotary() -> dict[str, str]:
    """Return the equations of a rotary pendulum, its angle 0 upright, by the inertia of the arm.

    ``b`` is the inertia of the pendulum, ``c`` couples it with the arm, and ``g`` is its weight;
    ``cable`` and ``rest`` are the spring of the cable and where it pulls to.
    """
    s, c = "sin(pendulum)", "cos(pendulum)"
    arm = (
        "(gain * voltage - d1 * arm_rate - c1 * tanh(arm_rate / 0.2) - cable * (arm - rest)"
        f" - 2 * b * {s} * {c} * arm_rate * pendulum_rate"
        f" + c * {s} * pendulum_rate * pendulum_rate)"
    )
    hanging = (
        f"(b * {s} * {c} * arm_rate * arm_rate + g * {s} - d2 * pendulum_rate"
        " - c2 * tanh(pendulum_rate / 0.2))"
    )
    m11, m12 = f"(1 + b * {s} * {s})", f"(c * {c})"
    det = f"({m11} * b - {m12} * {m12})"
    return {
        "arm": "arm_rate",
        "pendulum": "pendulum_rate",
        "arm_rate": f"({arm} * b - {m12} * {hanging}) / {det}",
        "pendulum_rate": f"({m11} * {hanging} - {m12} * {arm}) / {det}",
    }


def _quanser() -> dict[str, float]:
    """Return the constants of the equations from those that Quanser gives for the QUBE-Servo."""
    R, k, Mr, Lr, mp, Lp, Dr, Dp = 8.4, 0.042, 0.095, 0.085, 0.024, 0.129, 0.0015, 0.0005
    inertia = Mr * Lr**2 / 12 + mp * Lr**2
    own = {"gain": k / R, "d1": Dr + k * k / R, "b": mp * Lp**2 / 12 + mp * (Lp / 2) ** 2}
    own |= {"c": mp * Lr * Lp / 2, "g": mp * G * Lp / 2, "d2": Dp}
    return {name: value / inertia for name, value in own.items()}


QUANSER = _quanser()
"""R 8.4 Ω, k .042, arm .095 kg and .085 m, pendulum .024 kg and .129 m, friction .0015, .0005."""


class Controller(NamedTuple):
    """Feedback of angles and of their rates, which a filter of the first order takes."""

    proportional: tuple[float, ...]  # V/rad
    derivative: tuple[float, ...]  # V s/rad
    bandwidth: float  # 1/s
    limit: float  # V

    def step(self, memory: Array, angles: Array, dt: float) -> tuple[Array, float]:
        """Return the memory, (2, n), and the voltage, after angles, (n,), of the next sample."""
        last, rates = memory
        rates = (rates + self.bandwidth * (angles - last)) / (1.0 + self.bandwidth * dt)
        asked = np.dot(self.proportional, angles) + np.dot(self.derivative, rates)
        return np.array([angles, rates]), float(asked)


BALANCER = Controller((6.0, 30.0), (1.8, 2.5), 50.0, 10.0)
"""Controller that balanced the QUBE-Servo (``controller.toml`` of the source); it explains the
recorded inputs to 1e-8 V where there is no test signal."""

QUBE = Plant(
    states={"arm": "rad", "pendulum": "rad", "arm_rate": "rad/s", "pendulum_rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=0.002,
    gamma=10.0,
    known=_rotary(),
    constants={
        **{name: unknown(value) for name, value in QUANSER.items()},
        "c1": unknown(0.1 * QUANSER["d1"], factor=3.0),
        "c2": unknown(0.05 * QUANSER["d2"], factor=3.0),
        "cable": unknown(0.5, spread=2.0),
        "rest": unknown(0.0, spread=0.3),
    },
    learned=["arm_rate", "pendulum_rate"],
    angles=["arm", "pendulum"],
    box={"arm_rate": 10.0, "pendulum_rate": 10.0},
    measured={"arm": encoder(2048), "pendulum": encoder(2048)},
)
"""Quanser QUBE-Servo that balances; ten constants."""
