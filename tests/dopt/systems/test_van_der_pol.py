"""Van der Pol's cycle: its amplitude and period."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dopt.evaluation import simulate
from dopt.systems import VanDerPol


@pytest.mark.parametrize("start", [0.05, 4.0])
def test_free_motions_tend_to_the_cycle_of_the_textbook(start: float) -> None:
    """With μ = ω₀ it has the amplitude 2.009 a and the period 6.663 / ω₀."""
    system = VanDerPol(amplitude=0.5, damping=2.0, stiffness=4.0, dt=1e-3)
    system = dataclasses.replace(system, initial_state=(start * 0.5, 0.0))
    path = simulate(system, np.zeros((20_000, 1, 1)))[10_000:, 0, 0]
    assert path.max() == pytest.approx(0.5 * 2.009, rel=2e-3)
    upwards = np.flatnonzero((path[:-1] < 0) & (path[1:] >= 0))
    assert np.diff(upwards).mean() * system.dt == pytest.approx(6.663 / 2.0, rel=5e-3)
