"""Numbers of one stored trial for each frame of an animation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.data.learned_model import simulated_trial
from analysis.data.trial_selection import Entry
from analysis.errors import AnalysisError
from analysis.figures.phase_portraits.data import DrawnPlane
from dopt.geometry import Body, body
from dopt.rerun import rerun
from dopt.spec.trial import TrialSpec
from dopt.systems import System
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]

MARGIN = 0.08
"""Share of a range that is left free on each side of it."""


@dataclass(frozen=True)
class Story:
    """A trial of T steps, seen in k frames.

    Attributes
    ----------
    steps : (k,)
        Steps done at each frame, the first 0.
    states : (T + 1, d), inputs : (T, m), loss : (T,)
        As stored; the loss is that on the grid after each step. A trial that diverged has as many
        steps as lead from a stored state to another.
    body : Body or None
        The system at all states, None where it has none.
    plane : DrawnPlane
        Phase plane of the system.
    truth, learned : (T + 1, r), (k, T + 1, r)
        Accelerations at zero input along the whole trajectory, true and as modelled at each frame.
    """

    env: str
    policy: str
    seed: int
    system: System
    steps: npt.NDArray[np.int64]
    states: Array
    inputs: Array
    loss: Array
    body: Body | None
    plane: DrawnPlane
    truth: Array
    learned: Array


def tell(reader: Reader, entry: Entry, seed: int, frames: int) -> Story:
    """Read a trial and replay it, to know what its model had learned at each frame.

    Raises
    ------
    AnalysisError
        If the trial is not finished, diverged at its first step, or its replay does not lead
        through the stored states.
    """
    spec = _specification(entry, seed)
    stored = reader.trajectory(entry.config.config_key, seed)
    curves = reader.curves(entry.config.config_key)
    loss = curves.values[int(np.flatnonzero(curves.seeds == seed)[0])]
    end = int(np.isfinite(stored.states).all(axis=1).sum()) - 1
    if end < 1:
        raise AnalysisError(
            f"Seed {seed} of {entry.config.env} × {entry.config.policy} diverged at its first "
            f"steps, so that there is nothing to show: choose another with --seed."
        )
    steps = np.unique(np.linspace(0, end, frames).round().astype(np.int64))
    seen = rerun(spec, steps.tolist())
    _check_same(seen.states[: end + 1], stored.states[: end + 1], entry, seed)
    states = stored.states[: end + 1]
    learned = [spec.model.predict(spec.system, theta, states) for theta in seen.parameters]
    return Story(
        entry.config.env,
        entry.config.policy,
        seed,
        spec.system,
        seen.steps,
        states,
        stored.inputs[:end],
        loss[:end],
        body(spec.system, states),
        DrawnPlane.of(spec.system),
        spec.system.learned(states, np.arange(len(states))),
        np.array(learned),
    )


def _specification(entry: Entry, seed: int) -> TrialSpec:
    finished = {trial.seed for trial in entry.finished}
    if seed not in finished:
        listed = ", ".join(map(str, sorted(finished)[:10])) or "none"
        raise AnalysisError(
            f"{entry.config.env} × {entry.config.policy} has no finished trial of seed {seed}, "
            f"finished are {listed}: choose one of these with --seed."
        )
    return simulated_trial(entry.config, seed)


def _check_same(replayed: Array, stored: Array, entry: Entry, seed: int) -> None:
    if not np.allclose(replayed, stored, rtol=1e-6, atol=1e-9):
        raise AnalysisError(
            f"Seed {seed} of {entry.config.env} × {entry.config.policy} runs another way here than "
            f"it did when it was stored, so what its model knew is not known: it was run by "
            f"another version or on another kind of machine, run it again here in a database of "
            f"its own."
        )


def extent(values: Array, *others: Array) -> tuple[float, float]:
    """Return limits around all finite values, with a margin."""
    everything = np.concatenate([np.ravel(part) for part in (values, *others)])
    finite = everything[np.isfinite(everything)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    room = MARGIN * (high - low) or 1.0
    return low - room, high + room
