"""Low-pass filters of measured states: sums over all outputs, weighted by their age."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.kernel.run import KernelTrial
from dopt.randomness import draw
from dopt.types import Array
from tests.dopt.trials import trial


def low_passed(values: Array, start: Array, share: float) -> Array:
    """Return Σ_k s (1 - s)^(t - k) y_k after each of n values, (n, k), and a start, (k,)."""
    n = len(values)
    ages = np.arange(n)[:, None] - np.arange(n)[None]
    weights = np.where(ages >= 0, share * (1.0 - share) ** np.maximum(ages, 0), 0.0)
    begun: Array = (1.0 - share) ** np.arange(1, n + 1)
    filtered: Array = weights @ values + begun[:, None] * start
    return filtered


@pytest.mark.parametrize(
    ("env", "measured", "rates"), [("pendulum", [0], [1]), ("arm", [0, 2], [1, 3])]
)
def test_estimates_are_weighted_sums_of_what_was_measured(
    env: str, measured: list[int], rates: list[int]
) -> None:
    """Differences come one step late by the Euler map: positions and inputs wait for them."""
    noise = [1e-3] * len(measured)
    fields = {"horizon": 25, "measured_states": measured, "measurement_noise": noise}
    spec = trial(env, "random", 4, env=fields)
    run, system = KernelTrial(spec), spec.system
    run.advance(system.horizon)
    record, share = run.record, 1.0 - np.exp(-2.0 * np.pi * system.velocity_cutoff * system.dt)
    truth, start = record.true_states, np.array(system.initial_state)
    y = truth[1:, measured] + draw(spec).measurement_noise
    before = np.concatenate([start[None, measured], y[:-1]])
    positions = low_passed(y, start[measured], share)
    earlier = np.concatenate([start[None, measured], positions[:-1]])
    velocities = low_passed((y - before) / system.dt, start[rates], share)
    assert record.states[1:, measured] == pytest.approx(earlier, abs=1e-12)
    assert record.states[1:, rates] == pytest.approx(velocities, rel=1e-9, abs=1e-10)
    inputs = low_passed(record.inputs, np.zeros(system.n_inputs), share)
    late = np.concatenate([np.zeros((1, system.n_inputs)), inputs[:-1]])
    assert run.state.estimate.inputs == pytest.approx(late, abs=1e-12)
