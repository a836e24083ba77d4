"""Numbers that an agent is shown of a state."""

from __future__ import annotations

import math

import numpy as np

from dopt.systems import Cartpole, Quadrotor
from studies.agents.policies import LIMIT, Observation


def test_an_angle_is_shown_by_cosine_and_sine_and_others_by_half_widths() -> None:
    cartpole = Cartpole(grid_half_widths=(4.0, math.pi, 8.0))
    state = np.array([0.5, 2.0, math.pi / 6 + 4 * math.pi, -4.0])
    expected = [math.sqrt(3) / 2, 0.5, 0.5, 0.5, -0.5]
    np.testing.assert_allclose(Observation(cartpole)(state), expected)


def test_many_states_are_shown_row_by_row() -> None:
    observation = Observation(Quadrotor())
    states = np.random.default_rng(0).normal(size=(3, 5, 6))
    shown = observation(states)
    assert shown.shape == (3, 5, observation.size) == (3, 5, 7)
    np.testing.assert_array_equal(shown[1, 2], observation(states[1, 2]))


def test_nothing_large_is_shown() -> None:
    states = np.array([[1e9, -1e9, 1.0, 0.0]])
    shown = Observation(Cartpole())(states)
    assert np.abs(shown).max() == LIMIT
