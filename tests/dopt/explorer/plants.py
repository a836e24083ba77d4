"""Plants that the tests of explorations measure, and explorations of one of them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from dopt import Explorer, Plant
from dopt.systems.real import Flight
from dopt.types import Array
from orchestrate.store import Reader

MOTOR = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=0.02,
    gamma=6.0,
    known={"angle": "rate", "rate": "gain * voltage"},
    constants={"gain": 5.0},
    learned=["rate"],
    angles=["angle"],
    box={"rate": 10.0},
)
"""A motor that lifts an unbalanced disk."""


def motor_acceleration(x: Array) -> float:
    """Return what the exploration learns of the motor."""
    return float(-8.0 * np.sin(x[0]) - 0.6 * x[1])


def following(x: Array, u: Array, dt: float = MOTOR.dt) -> Array:
    """Return the state of the motor dt seconds later, by the Euler map."""
    return x + dt * np.array([x[1], 5.0 * u[0] + motor_acceleration(x)])


class Rig:
    """The motor behind a delay [samples], a lag [s] and a supply [V], and what acted."""

    def __init__(
        self, delay: float = 0.0, lag: float = 0.0, supply: float = math.inf, substeps: int = 1
    ) -> None:
        self._flight = Flight(round(delay, 9), lag, MOTOR.dt, 1)
        self._supply, self._substeps = supply, substeps
        self.x, self.time = np.array([0.1, 0.0]), 0.0
        self.acted: list[Array] = []

    def step(self, u: Array) -> Array:
        self.acted.append(self._flight.depart(np.clip(u, -self._supply, self._supply)))
        for _ in range(self._substeps):
            self.x = following(self.x, self.acted[-1], MOTOR.dt / self._substeps)
        self.time += MOTOR.dt
        return self.x


HOVERCRAFT = Plant(
    states={"speed": "m/s", "heading": "rad", "spin": "rad/s"},
    inputs={"thrust": "N", "torque": "N m"},
    dt=0.02,
    gamma=4.0,
    known={"speed": "thrust", "heading": "spin", "spin": "2 * torque"},
    learned=["speed", "spin"],
    angles=["heading"],
    box={"speed": 2.0, "spin": 3.0},
)
"""A plant of two inputs, whose plans are points of a circle and not one of two numbers."""


def steered(x: Array, u: Array, dt: float = HOVERCRAFT.dt) -> Array:
    """Return the state of the hovercraft dt seconds later."""
    drag, wind = -0.8 * x[0] * abs(x[0]), np.sin(x[1])
    return x + dt * np.array([u[0] + drag + wind, x[2], 2.0 * u[1] - 0.5 * x[2]])


STEPS = 300


def explorer(**more: Any) -> Explorer:
    return Explorer(MOTOR, **{"policy": "random", "steps": STEPS, **more})


def drive(one: Explorer, steps: int, x: Array | None = None) -> Array:
    """Let the motor follow the answers of an explorer, from a state on; return the last state."""
    if x is None:
        x = one.states[-1] if one.n_steps else np.array([0.1, 0.0])
    for _ in range(steps):
        x = following(x, one.ask(x))
        one.tell(x)
    return x


def content(url: str) -> dict[str, Any]:
    """Return what a database holds of its only trial, except times."""
    with Reader.open(url) as reader, reader.moment() as moment:
        [trial] = moment.rows("SELECT * FROM v_trial")
        stored = moment.trajectory(trial.config_key, trial.seed)
        steps = moment.rows("SELECT t, loss, reachable_loss FROM step ORDER BY t")
        assessed = moment.rows("SELECT t, measure, value FROM assessment ORDER BY t")
    names = ("trial_key", "label", "env", "status", "n_steps", "final_loss", "best_loss")
    return {
        **{name: getattr(trial, name) for name in names},
        "steps": [tuple(row) for row in steps],
        "arrays": [stored.states.tolist(), stored.inputs.tolist(), stored.parameters.tolist()],
        "assessed": [tuple(row) for row in assessed],
    }


def without_checksums(journal: Path) -> str:
    """Return the lines of a journal as programs wrote them before there were checksums."""
    text = re.sub(r', "sum": "\w+"}\n', "}\n", journal.read_text())
    return text.replace('"format": 2', '"format": 1', 1)
