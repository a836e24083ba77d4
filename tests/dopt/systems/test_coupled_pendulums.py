"""Coupled pendulums in any number: their modes, and what they say of themselves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from dopt.errors import SpecificationError
from dopt.systems import CoupledPendulums
from dopt.systems.pendulum import LARGEST_ROW
from dopt.systems.properties import jacobians
from tests.dopt.systems.compiled import assert_compiled_equations_agree
from tests.dopt.systems.mechanics import CoupledPendulumsMechanics


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_row_of_any_length_obeys_euler_and_lagrange(n: int) -> None:
    row, rng = CoupledPendulums(n_pendulums=n, gravity=2.0, coupling=3.0), np.random.default_rng(n)
    for _ in range(5):
        x, u = rng.normal(size=2 * n), rng.normal(size=1)
        mechanics = CoupledPendulumsMechanics(row)
        expected = mechanics.accelerations(torch.tensor(x), torch.tensor(u)).numpy()
        assert row.derivative(x, u)[1::2] == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_a_row_swings_in_the_modes_of_a_lattice_with_free_ends(n: int) -> None:
    """ω² = ω₀² + 4 κ sin²(π k / 2n) for k = 0 … n - 1."""
    row = CoupledPendulums(n_pendulums=n, gravity=1.5, coupling=4.0, friction=0.0)
    A, _ = jacobians(row, (0.0,) * 2 * n, np.zeros(1))
    squares = np.sort(-(np.linalg.eigvals(A) ** 2).real)[::2]
    expected = 1.5 + 16.0 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2
    assert squares == pytest.approx(expected, rel=1e-5)


def test_the_longest_row_loses_energy_in_every_mode_under_the_euler_map() -> None:
    row = CoupledPendulums(n_pendulums=LARGEST_ROW)
    A, _ = jacobians(row, (0.0,) * row.n_states, np.zeros(1))
    assert np.abs(np.linalg.eigvals(np.eye(row.n_states) + row.dt * A)).max() < 1.0


def test_the_input_turns_the_first_pendulum_alone() -> None:
    row = CoupledPendulums(n_pendulums=4)
    x = np.random.default_rng(0).normal(size=8)
    change = row.derivative(x, [2.0]) - row.derivative(x, [0.0])
    assert change == pytest.approx([0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("n", [1, 3])
def test_compiled_equations_are_those_of_a_row_of_that_length(n: int) -> None:
    row, rng = CoupledPendulums(n_pendulums=n), np.random.default_rng(n)
    assert_compiled_equations_agree(row, rng.normal(size=2 * n), rng.normal(size=1))


def test_what_depends_on_the_number_of_pendulums_follows_it() -> None:
    row = CoupledPendulums(n_pendulums=3, initial_state=(0.1, 0.2), friction=0.5)
    assert (row.n_states, row.n_inputs, row.n_learned) == (6, 1, 3)
    assert row.linear_parameters == ("friction_1", "friction_2", "friction_3")
    assert row.parameters == (1.0, 6.25, 0.5, 0.5, 0.5)
    assert (row.initial_state, row.grid_half_widths) == ((0.1, 0.2) * 3, (3.0,) * 3)
    assert dataclasses.replace(row) == row


def test_rows_without_number_are_refused() -> None:
    with pytest.raises(SpecificationError, match=r"n_pendulums is 51, .* at most 50"):
        CoupledPendulums(n_pendulums=51)
    with pytest.raises(SpecificationError, match=r"initial_state has 3 entries, .* needs 4"):
        CoupledPendulums(n_pendulums=2, initial_state=(0.0, 0.0, 0.0))
