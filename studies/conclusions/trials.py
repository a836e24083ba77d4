"""The trials of the study, and the numbers that are kept of each."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from analysis.stats.curves import periodogram
from dopt.evaluation import box_states
from dopt.offline_fit import sample_loss
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.properties import eigenmode
from dopt.types import Array
from studies.conclusions.disk import DELAY, Disk

STEPS = 500
SYSTEMS = ("pendulum", "cartpole", "arm", "quadrotor")
EVIDENCE: dict[str, Any] = {"name": "gaussian_process", "hyperparameters": "evidence"}

LEARNERS: dict[str, dict[str, Any]] = {
    "adam_window": {"model": "mlp", "learner": "adam_window"},
    "gauss_newton": {"model": "mlp", "learner": "gauss_newton"},
    "evidence": {"model": EVIDENCE, "learner": "conditioning"},
}
"""The paper's network and rule, the same network fitted to all samples, and the process."""

PLANTS: dict[str, dict[str, Any]] = {
    "delay": {"delay": 1.0},
    "encoder": {"counts": 2048.0},
    "friction": {"coulomb": 0.5},
    "disk": {"delay": DELAY / Disk.dt},
}
"""Hardware around the pendulum, or the disk: late samples, counts a turn, dry friction [1/s²]."""

WITHIN = 0.25
"""Part of the eigenfrequency by which an input may differ from it."""


class Cell(NamedTuple):
    """Trials that differ by their seed."""

    env: str
    plant: str
    policy: str
    learner: str

    def spec(self, seed: int) -> TrialSpec:
        """Return one trial."""
        sections: dict[str, Any] = {
            "env": {"horizon": STEPS} | system_of(self.env),
            "policy": {"name": self.policy},
            "seed": seed,
        }
        if self.policy == "best":
            sections["policy"] = BEST[self.env]
        elif self.policy == "d_optimal" and self.learner == "evidence":
            sections["policy"] = {"name": "exact"}
        elif self.policy == "periodic" and self.env == Disk.name:  # whose friction hides its mode
            sections["policy"]["frequency"] = math.sqrt(Disk.gravity)
        if self.policy == "oracle":
            sections |= {
                "model": {"name": "linear"},
                "learner": {"name": "recursive_least_squares"},
            }
        else:
            model, learner = LEARNERS[self.learner].values()
            sections["model"] = model if isinstance(model, dict) else {"name": model}
            sections["learner"] = {"name": learner}
        if self.plant != "ideal":
            sections["plant"] = {"name": "real", **PLANTS[self.plant]}
            if self.learner == "evidence":
                sections["model"] = {**EVIDENCE, "noise": "fitted"}
        return TrialSpec.from_mapping(sections)


def system_of(env: str) -> dict[str, Any]:
    """Return what names a system in a specification."""
    return {"_target_": f"{Disk.__module__}.Disk"} if env == Disk.name else {"name": env}


def explored(plant: str) -> str:
    """Return the system that hardware stands around."""
    return Disk.name if plant == Disk.name else "pendulum"


BOX: dict[str, Any] = {"name": "episodic", "criterion": "variance", "domain": "box"}
NEAR = BOX | {"lookahead": 30, "replan_every": 10, "stride": 3, "hold": 10}
BEST: dict[str, dict[str, Any]] = {
    "pendulum": NEAR,
    "cartpole": BOX | {"lookahead": 80, "replan_every": 10, "stride": 5, "hold": 20},
    "quadrotor": NEAR,
}
"""Plans many steps ahead for the evidence model, chosen on seeds 1000 to 1005."""


def cells() -> list[list[Cell]]:
    """Return the cells, in groups that run one after the other."""
    policies = {
        env: ("d_optimal", "random", "uniform", *(["periodic"] if env != "quadrotor" else []))
        for env in SYSTEMS
    }
    ideal = [
        Cell(env, "ideal", one, name)
        for env in SYSTEMS
        for one in policies[env]
        for name in LEARNERS
    ]
    first = [Cell(env, "ideal", "best", "evidence") for env in BEST]
    first.append(Cell("pendulum", "ideal", "oracle", "least_squares"))
    hardware = [
        Cell(explored(plant), plant, one, name)
        for plant in PLANTS
        for one in policies["pendulum"]
        for name in LEARNERS
    ]
    groups = [first]
    for slow in (False, True):
        groups += [
            [one for one in part if (one.learner == "gauss_newton") == slow]
            for part in (ideal, hardware)
        ]
    return groups


class Row(NamedTuple):
    """What is kept of a trial; NaN where there is nothing to say.

    Attributes
    ----------
    loss : float
        After the last step.
    sample_loss : float
        Of the evidence model fitted offline to the same samples, on ideal plants.
    step_ms, worst_ms : float
        Mean and longest time of a step.
    width : float
        Root mean square of the states within the grid's axes, in half-widths of the box.
    gap : float
        Mean distance from a state of the box to the nearest one visited, in half-widths.
    resonant : float
        Share of the power of the inputs within 25 % of the eigenfrequency.
    """

    loss: float
    sample_loss: float
    step_ms: float
    worst_ms: float
    width: float
    gap: float
    resonant: float


def row(cell: Cell, seed: int) -> Row:
    """Run a trial and measure it."""
    spec = cell.spec(seed)
    result = run_trial(spec)
    step = (result.plan_us + result.learn_us) / 1e3
    if result.diverged_at is not None:
        return Row(*[math.nan] * len(Row._fields))
    width, gap = _extent(spec.system, result.states)
    # Of the evidence model the loss itself is nearly the same.
    sampled = cell.plant == "ideal" and (cell.learner != "evidence" or cell.policy == "best")
    return Row(
        float(result.loss[-1]),
        sample_loss(spec, result.states, result.inputs) if sampled else math.nan,
        float(step.mean()),
        float(step.max()),
        width,
        gap,
        _resonant(spec.system, result.inputs),
    )


def _extent(system: System, states: Array) -> tuple[float, float]:
    """Return width and gap of states, (T + 1, d); angles are taken on the circle."""
    visited, box = (_in_half_widths(system, one) for one in (states, box_states(system)))
    distances, _ = cKDTree(visited).query(box)
    return float(np.sqrt(np.mean(visited**2))), float(np.mean(distances))


def _in_half_widths(system: System, states: Array) -> Array:
    columns = []
    for index, half in zip(system.grid_indices, system.grid_half_widths, strict=True):
        values = states[:, index]
        if index in system.angle_indices:
            values = (values + np.pi) % (2 * np.pi) - np.pi
        columns.append(values / half)
    return np.stack(columns, axis=1)


def _resonant(system: System, inputs: Array) -> float:
    mode = eigenmode(system)
    if mode is None:
        return math.nan
    frequency, density = periodogram(inputs[None], system.dt)
    near = np.abs(2 * math.pi * frequency / mode.frequency - 1.0) <= WITHIN
    return float(density[0, near].sum() / density[0].sum())
