"""Cost of a step on a black box, and of a step of MuJoCo through the interface of black boxes."""

from __future__ import annotations

import importlib.util
import sys
import time
from statistics import median

import numpy as np

from benchmarks.processes import ROOT
from benchmarks.rows import Row
from dopt.policies.base import on_sphere
from dopt.randomness import episode_seed
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SIMULATORS
from dopt.systems.black_box import BlackBox
from dopt.systems.mujoco import MuJoCo
from dopt.types import Array

ROUNDS = 5
ENGINE_STEPS = 2000
"""Steps of MuJoCo in a round."""


def measure(quick: bool) -> list[Row]:
    """Return the cost of a step beside Gymnasium, and of a step of each model of MuJoCo."""
    return [*_beside_gymnasium(quick), *_steps_of_mujoco(quick)]


def _beside_gymnasium(quick: bool) -> list[Row]:
    """Return the cost of a step on the pendulum of Gymnasium, at q = 386, in whole trials."""
    if importlib.util.find_spec("gymnasium") is None:
        return [Row("black box", None, note="gymnasium is not installed")]
    folder = str(ROOT / "docs" / "example")
    sys.path.insert(0, folder)
    try:
        spec = TrialSpec.from_mapping(
            {
                "env": {"_target_": "swing.Swing"},
                "policy": {"name": "d_optimal"},
                "model": {"name": "mlp"},
                "learner": {"name": "adam_window"},
                "seed": 0,
            }
        )
    finally:
        sys.path.remove(folder)
    run_trial(spec)
    costs, alone = zip(
        *(_cost(spec.with_seed(i)) for i in range(1 if quick else ROUNDS)), strict=True
    )
    note = f"the environment's own step takes {1e6 * median(alone):.0f} µs"
    return [
        Row("D-optimal step beside a Gymnasium environment", 1e6 * median(costs), "µs", note=note)
    ]


def _cost(spec: TrialSpec) -> tuple[float, float]:
    """Return seconds a step beside the environment, and those of the environment."""
    start = time.perf_counter()
    result = run_trial(spec)
    whole = time.perf_counter() - start
    assert isinstance(spec.system, BlackBox)
    alone = _episode(spec.system, episode_seed(spec.seed), result.inputs)
    steps = len(result.inputs)
    return (whole - alone) / steps, alone / steps


def _episode(system: BlackBox, seed: int, inputs: Array) -> float:
    """Return the seconds of an episode with given inputs, whose states are read at each step."""
    start = time.perf_counter()
    episode = system.episode(seed)
    for u in inputs:
        episode.step(u)
        _ = episode.state
    return time.perf_counter() - start


def _steps_of_mujoco(quick: bool) -> list[Row]:
    """Return the time of a step and of reading its state beside that of the engine's own step."""
    if importlib.util.find_spec("mujoco") is None:
        return [Row("step of MuJoCo", None, note="mujoco is not installed")]
    return [
        _step_of_mujoco(system(), 1 if quick else ROUNDS)
        for system in SIMULATORS.values()
        if issubclass(system, MuJoCo)
    ]


def _step_of_mujoco(system: MuJoCo, rounds: int) -> Row:
    draws = np.random.default_rng(0).standard_normal((ENGINE_STEPS, system.n_inputs))
    inputs = on_sphere(draws, system.gamma)
    system.episode(0)  # loads the model
    whole, own = zip(
        *((_episode(system, 0, inputs), _own_steps(system, inputs)) for _ in range(rounds)),
        strict=True,
    )
    took, alone = (1e6 * median(each) / ENGINE_STEPS for each in (whole, own))
    note = f"the engine's own step takes {alone:.1f} µs"
    return Row(f"step of {system.name}", took, "µs", note=note)


def _own_steps(system: MuJoCo, inputs: Array) -> float:
    """Return the seconds of the same steps without the interface."""
    import mujoco

    model = system.load()
    data = mujoco.MjData(model)
    data.qpos[:] = system.start
    start = time.perf_counter()
    for u in inputs:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    return time.perf_counter() - start
