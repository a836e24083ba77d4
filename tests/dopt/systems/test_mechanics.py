"""The equations of motion against masses in a plane."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.evaluation import simulate
from dopt.systems import SYSTEMS, System
from tests.dopt.systems.mechanics import (
    FRICTION,
    HOVERING,
    MECHANICS,
    SELF_EXCITED,
    WITHOUT_INERTIA,
    Mechanics,
)
from tests.dopt.systems.strategies import NAMES, inputs, states, systems

closed = pytest.mark.parametrize("name", sorted(set(FRICTION) - set(HOVERING)))
mechanical = pytest.mark.parametrize("name", [n for n in NAMES if SYSTEMS[n] in MECHANICS])


def mechanics_of(system: System) -> Mechanics:
    return MECHANICS[type(system)](system)


def energy_rate(system: System, state: np.ndarray, flow: np.ndarray) -> tuple[float, float]:
    """Return dE/dt along the flow and the size of the terms that it is the sum of."""
    slope = torch.func.grad(mechanics_of(system).energy)(torch.tensor(state)).numpy()
    return float(slope @ flow), float(np.abs(slope) @ np.abs(flow))


def test_every_registered_system_with_inertia_is_held_against_masses() -> None:
    held = {name for name in NAMES if SYSTEMS[name] in MECHANICS}
    assert held == set(FRICTION) == set(NAMES) - set(WITHOUT_INERTIA)


@mechanical
@settings(max_examples=10)
@given(data=st.data())
def test_energy_changes_by_input_power_less_friction_power(name: str, data: st.DataObject) -> None:
    system = data.draw(systems(name))
    x, u = data.draw(states(name)), data.draw(inputs(name))
    rate, size = energy_rate(system, x, system.derivative(x, u))
    power = float(mechanics_of(system).power(torch.tensor(x), torch.tensor(u)))
    assert rate == pytest.approx(power, abs=1e-12 * (1.0 + size))


@closed
@settings(max_examples=10)
@given(data=st.data())
def test_nothing_is_gained_or_lost_without_friction_and_input(
    name: str, data: st.DataObject
) -> None:
    system = data.draw(systems(name, **dict.fromkeys(FRICTION[name], 0.0)))
    x = data.draw(states(name))
    rate, size = energy_rate(system, x, system.derivative(x, np.zeros(system.n_inputs)))
    assert rate == pytest.approx(0.0, abs=1e-12 * (1.0 + size))


@pytest.mark.parametrize("name", sorted(set(FRICTION) - {*SELF_EXCITED, *HOVERING}))
@settings(max_examples=10)
@given(data=st.data())
def test_friction_never_feeds_energy(name: str, data: st.DataObject) -> None:
    system, x = data.draw(systems(name)), data.draw(states(name))
    rate, size = energy_rate(system, x, system.derivative(x, np.zeros(system.n_inputs)))
    assert rate <= 1e-12 * (1.0 + size)


@mechanical
@settings(max_examples=10)
@given(data=st.data())
def test_equations_are_those_of_euler_and_lagrange(name: str, data: st.DataObject) -> None:
    system = data.draw(systems(name))
    x, u = data.draw(states(name)), data.draw(inputs(name))
    mechanics = mechanics_of(system)
    expected = mechanics.accelerations(torch.tensor(x), torch.tensor(u)).numpy()
    flow = torch.tensor(system.derivative(x, u))
    (_, rates), (moved, found) = torch.func.jvp(mechanics.split, (torch.tensor(x),), (flow,))
    assert moved.numpy() == pytest.approx(rates.numpy(), rel=1e-12, abs=1e-12)
    size = np.abs(expected).max() + 1.0
    assert found.numpy() == pytest.approx(expected, rel=0.0, abs=1e-9 * size)


@closed
def test_halving_the_step_halves_the_energy_drift(name: str) -> None:
    drifts = [abs(_drift(name, dt)) for dt in (1e-3, 5e-4)]
    assert drifts[0] > 0.0
    assert drifts[0] / drifts[1] == pytest.approx(2.0, rel=0.05)


def _drift(name: str, dt: float) -> float:
    """Return the energy gained in 1 s of free motion without friction, by steps of ``dt``."""
    start = tuple(0.3 + 0.2 * i for i in range(len(SYSTEMS[name].state_labels)))
    system = dataclasses.replace(
        SYSTEMS[name](), dt=dt, initial_state=start, **dict.fromkeys(FRICTION[name], 0.0)
    )
    free = np.zeros((math.ceil(1.0 / dt), 1, system.n_inputs))
    path = torch.tensor(simulate(system, free)[:, 0])
    energy = mechanics_of(system).energy
    return float(energy(path[-1]) - energy(path[0]))
