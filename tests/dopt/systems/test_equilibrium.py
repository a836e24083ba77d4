from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.systems import Arm, Cartpole, MassSpring, Pendulum, Quadrotor
from dopt.systems.properties import eigenmode, euler_spectral_radius, jacobians
from tests.dopt.systems.strategies import NAMES, inputs, states, systems


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=20)
@given(data=st.data())
def test_jacobians_are_the_slopes_of_the_flow(name: str, data: st.DataObject) -> None:
    system = data.draw(systems(name))
    x, u = data.draw(states(name, 2.0)), data.draw(inputs(name, 2.0))
    A, B = jacobians(system, x, u)
    step = 1e-5
    for slopes, point, vary in (
        (A, x, lambda dx: system.derivative(x + dx, u)),
        (B, u, lambda du: system.derivative(x, u + du)),
    ):
        moves = step * np.eye(len(point))
        numeric = np.stack([(vary(e) - vary(-e)) / (2 * step) for e in moves], axis=1)
        # |v| v of the drag bends at v = 0: a central difference is off by its step there.
        assert slopes == pytest.approx(numeric, rel=1e-5, abs=1e-3 * np.abs(slopes).max() + 1e-4)


@pytest.mark.parametrize("system", [Pendulum(), Cartpole(), Arm()], ids=lambda s: s.name)
def test_nothing_moves_at_the_equilibrium(system: Pendulum | Cartpole | Arm) -> None:
    flow = system.derivative(np.array(system.equilibrium), np.zeros(system.n_inputs))
    assert flow == pytest.approx(0.0, abs=1e-14)


@given(st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(1.0, 20.0), st.floats(0.0, 0.99))
def test_a_pendulum_swings_at_the_damped_frequency(
    mass: float, length: float, gravity: float, ratio: float
) -> None:
    natural = math.sqrt(1.5 * gravity / length)
    inertia = mass * length**2 / 3.0
    pendulum = Pendulum(
        mass=mass, length=length, gravity=gravity, friction=2.0 * ratio * natural * inertia
    )
    mode = eigenmode(pendulum)
    assert mode is not None
    assert mode.frequency == pytest.approx(natural * math.sqrt(1.0 - ratio**2), rel=1e-6)
    assert mode.decay == pytest.approx(ratio * natural, rel=1e-6, abs=1e-9)
    assert np.abs(mode.direction) == pytest.approx(1.0)


def test_an_overdamped_pendulum_has_no_mode() -> None:
    assert eigenmode(Pendulum(friction=10.0)) is None


def test_a_quadrotor_has_no_mode() -> None:
    assert eigenmode(Quadrotor()) is None


def test_a_free_cartpole_swings_against_its_cart() -> None:
    cartpole = Cartpole(cart_mass=2.0, pole_mass=0.5, length=0.7, pivot_friction=0, cart_friction=0)
    mode = eigenmode(cartpole)
    assert mode is not None
    assert mode.frequency == pytest.approx(math.sqrt(10.0 / 0.7 * (1 + 0.5 / 2.0)), rel=1e-9)


@pytest.mark.parametrize("stiffness", [7.0, 9.9, 10.0, 10.1, 11.0, 12.0, 13.0])
def test_of_equally_damped_modes_the_slowest_is_taken(stiffness: float) -> None:
    mode = eigenmode(MassSpring(stiffness=stiffness, damping=0.0))
    assert mode is not None
    assert mode.frequency == pytest.approx(math.sqrt(stiffness), rel=1e-9)


def test_the_arm_mode_is_a_normal_mode_driven_along_its_best_direction() -> None:
    arm = Arm(friction=1e-3)
    mode = eigenmode(arm)
    assert mode is not None
    normal = [math.sqrt((2.0 + sign * math.sqrt(2.0)) * 10.0) for sign in (-1, 1)]
    assert min(abs(mode.frequency - w) for w in normal) < 1e-4
    A, B = jacobians(arm, np.zeros(4), np.zeros(2))
    angles = np.linspace(0.0, np.pi, 721)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    response = np.linalg.solve(1j * mode.frequency * np.eye(4) - A, B @ directions)
    best = directions[:, np.argmax(np.linalg.norm(response, axis=0))]
    assert abs(best @ mode.direction) > 1.0 - 1e-4
    assert np.linalg.norm(mode.direction) == pytest.approx(1.0)


def test_euler_steps_of_a_frictionless_pendulum_are_unstable_at_rest() -> None:
    assert euler_spectral_radius(Pendulum(friction=0.0)) > 1.0
