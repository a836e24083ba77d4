"""The chain of any length: its kin, its modes, and what it says of itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from dopt.errors import SpecificationError
from dopt.systems import Arm, Chain, Feature
from dopt.systems.properties import jacobians
from tests.dopt.systems.compiled import assert_compiled_equations_agree
from tests.dopt.systems.mechanics import ChainMechanics

CONSTANTS = {"mass": 0.7, "length": 0.6, "friction": 0.3}


def point(system: Chain, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=system.n_states), rng.normal(size=system.n_inputs)


@pytest.mark.parametrize("n_links", [1, 2, 3, 7])
def test_a_chain_of_any_length_obeys_euler_and_lagrange(n_links: int) -> None:
    chain = Chain(n_links=n_links, **CONSTANTS)
    for seed in range(5):
        x, u = point(chain, seed)
        expected = ChainMechanics(chain).accelerations(torch.tensor(x), torch.tensor(u)).numpy()
        flow = chain.derivative(x, u)
        assert flow[1::2] == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert np.array_equal(flow[::2], x[1::2])


def test_a_chain_of_two_links_is_an_arm() -> None:
    """The arm's torques turn its links against the ground, the chain's against each other."""
    chain = Chain(n_links=2, **CONSTANTS)
    arm = Arm(mass_1=0.7, mass_2=0.7, length_1=0.6, length_2=0.6, friction=0.3)
    for seed in range(5):
        x, u = point(chain, seed)
        on_links = np.array([u[0] - u[1], u[1]])
        assert chain.derivative(x, u) == pytest.approx(arm.derivative(x, on_links), rel=1e-11)


@pytest.mark.parametrize("n_links", [1, 2, 5])
def test_a_hanging_chain_swings_at_the_zeros_of_a_laguerre_polynomial(n_links: int) -> None:
    """ω² l / g are the zeros of L_n, as Daniel Bernoulli found for the loaded string."""
    chain = Chain(n_links=n_links, length=0.6, friction=0.0)
    A, _ = jacobians(chain, chain.equilibrium or (), np.zeros(n_links))
    squares = np.sort(-(np.linalg.eigvals(A) ** 2).real)[::2]
    zeros = np.polynomial.laguerre.lagroots(np.eye(n_links + 1)[-1])
    assert squares == pytest.approx(zeros * 10.0 / 0.6, rel=1e-6)


@pytest.mark.parametrize("n_links", [1, 3, 5])
def test_compiled_equations_are_those_of_a_chain_of_that_length(n_links: int) -> None:
    chain = Chain(n_links=n_links, **CONSTANTS)
    assert_compiled_equations_agree(chain, *point(chain, 1))


def test_what_depends_on_the_number_of_links_follows_it() -> None:
    chain = Chain(n_links=3, initial_state=(0.1, 0.2), grid_half_widths=(1, 2, 3, 4, 5, 6))
    assert (chain.n_states, chain.n_inputs, chain.n_learned) == (6, 3, 3)
    assert chain.initial_state == (0.1, 0.2) * 3
    assert chain.features[-1] == Feature("identity", 5)
    assert chain.feature_scales == (1, 1, 2, 1, 1, 4, 1, 1, 6)
    assert dataclasses.replace(chain) == chain
    assert Chain.learned_rows == Chain().learned_rows == (1, 3, 5, 7, 9)


def test_links_without_number_are_refused() -> None:
    with pytest.raises(SpecificationError, match=r"n_links is 101, .* at most 100"):
        Chain(n_links=101)
    with pytest.raises(SpecificationError, match=r"initial_state has 3 entries, but chain needs 4"):
        Chain(n_links=2, initial_state=(0.0, 0.0, 0.0))
