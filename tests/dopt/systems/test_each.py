"""Properties of single systems, elementary functions, and drawings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from analysis.film import body
from dopt.errors import SpecificationError
from dopt.evaluation import simulate
from dopt.kernel.equations import compiled_equations
from dopt.spec.custom_system import check_system
from dopt.systems import (
    SYSTEMS,
    Arm,
    Car,
    Cartpole,
    Chain,
    CoupledPendulums,
    Drone,
    Feature,
    MassSpring,
    MovingStar,
    Pendulum,
    Quadrotor,
    System,
    VanDerPol,
)
from dopt.systems.elementary import cos, magnitude, sign, sin, tanh, where
from dopt.systems.properties import jacobians
from tests.dopt.systems.mechanics import MECHANICS
from tests.dopt.test_checks import broken_system


@pytest.mark.parametrize("x", [math.inf, -math.inf, math.nan, complex(math.inf, 0.0)])
@pytest.mark.parametrize("function", [sin, cos, tanh])
def test_infinite_numbers_give_what_arrays_give(function: Any, x: complex) -> None:
    with np.errstate(all="ignore"):
        expected = function(np.array([x]))[0]
    np.testing.assert_equal(abs(function(x)), abs(expected))


def test_without_steering_it_drives_straight_on_to_its_terminal_speed() -> None:
    car = Car()
    path = simulate(car, np.tile([1.0, 0.0], (1500, 1, 1)))[-1, 0]
    assert path[3] == pytest.approx(math.sqrt(car.motor / car.drag), rel=1e-6)
    assert path[[1, 2, 4, 5, 6]] == pytest.approx(0.0, abs=1e-12)


def test_a_slow_car_with_grip_turns_about_the_point_where_its_axles_meet() -> None:
    """The yaw rate without slip is vₓ tan δ divided by the distance of the axles."""
    car = Car(front_grip=600.0, rear_grip=600.0, dt=1e-3)
    path = simulate(car, np.tile([0.05, 0.5], (6000, 1, 1)))[-1, 0]
    assert path[6] == pytest.approx(0.3, rel=1e-6)
    turning = path[3] * math.tan(0.3) / (car.front + car.rear)
    assert path[5] == pytest.approx(turning, rel=0.02)
    assert path[4] == pytest.approx(car.rear * path[5], rel=0.02)


def test_a_tyre_never_pulls_harder_than_its_grip() -> None:
    car = Car(drag=0.0)
    rng = np.random.default_rng(0)
    rows = car.learned(rng.normal(scale=20.0, size=(500, 7)))
    force = car.mass * np.linalg.norm(rows[:, :2], axis=1)
    assert force.max() <= car.front_grip + car.rear_grip
    assert force.max() > 0.9 * (car.front_grip + car.rear_grip)


CONSTANTS = {"mass": 0.7, "length": 0.6, "friction": 0.3}


def point(system: System, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=system.n_states), rng.normal(size=system.n_inputs)


@pytest.mark.parametrize("n_links", [1, 2, 5])
def test_a_hanging_chain_swings_at_the_zeros_of_a_laguerre_polynomial(n_links: int) -> None:
    """ω² l / g are the zeros of L_n, as Daniel Bernoulli found for the loaded string."""
    chain = Chain(n_links=n_links, length=0.6, friction=0.0)
    A, _ = jacobians(chain, chain.equilibrium or (), np.zeros(n_links))
    squares = np.sort(-(np.linalg.eigvals(A) ** 2).real)[::2]
    zeros = np.polynomial.laguerre.lagroots(np.eye(n_links + 1)[-1])
    assert squares == pytest.approx(zeros * 10.0 / 0.6, rel=1e-6)


def test_what_depends_on_the_number_of_links_follows_it() -> None:
    chain = Chain(n_links=3, initial_state=(0.1, 0.2), grid_half_widths=(1, 2, 3, 4, 5, 6))
    assert (chain.n_states, chain.n_inputs, chain.n_learned) == (6, 3, 3)
    assert chain.initial_state == (0.1, 0.2) * 3
    assert chain.features[-1] == Feature("identity", 5)
    assert chain.feature_scales == (1, 1, 2, 1, 1, 4, 1, 1, 6)
    assert dataclasses.replace(chain) == chain
    assert Chain.learned_rows == Chain().learned_rows == (1, 3, 5, 7, 9)
    with pytest.raises(SpecificationError, match=r"n_links is 101, .* at most 100"):
        Chain(n_links=101)
    with pytest.raises(SpecificationError, match=r"initial_state has 3 entries, but chain needs 4"):
        Chain(n_links=2, initial_state=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "system",
    [
        *(Chain(n_links=n, **CONSTANTS) for n in (1, 2, 3, 7)),
        *(CoupledPendulums(n_pendulums=n, gravity=2.0, coupling=3.0) for n in (1, 2, 5)),
    ],
)
def test_chains_and_rows_of_any_length_obey_euler_and_lagrange(system: System) -> None:
    mechanics = MECHANICS[system.name](system)
    for seed in range(5):
        x, u = point(system, seed)
        expected = mechanics.accelerations(torch.tensor(x), torch.tensor(u)).numpy()
        flow = system.derivative(x, u)
        assert flow[1::2] == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert np.array_equal(flow[::2], x[1::2])


@pytest.mark.parametrize("n", [1, 2, 7])
def test_a_row_swings_in_the_modes_of_a_lattice_with_free_ends(n: int) -> None:
    """ω² = ω₀² + 4 κ sin²(π k / 2n) for k = 0 … n - 1."""
    row = CoupledPendulums(n_pendulums=n, gravity=1.5, coupling=4.0, friction=0.0)
    A, _ = jacobians(row, (0.0,) * 2 * n, np.zeros(1))
    squares = np.sort(-(np.linalg.eigvals(A) ** 2).real)[::2]
    expected = 1.5 + 16.0 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2
    assert squares == pytest.approx(expected, rel=1e-5)


def test_the_longest_row_loses_energy_in_every_mode_under_the_euler_map() -> None:
    row = CoupledPendulums(n_pendulums=CoupledPendulums.most)
    A, _ = jacobians(row, (0.0,) * row.n_states, np.zeros(1))
    assert np.abs(np.linalg.eigvals(np.eye(row.n_states) + row.dt * A)).max() < 1.0


def test_an_upright_drone_hovers_and_one_upside_down_falls() -> None:
    drone = Drone()
    assert drone.derivative(drone.initial_state, np.zeros(4)) == pytest.approx(0.0, abs=1e-14)
    over = np.zeros(13)
    over[7] = 1.0  # half a turn about the body's x axis
    fall = drone.derivative(over, np.zeros(4))
    assert fall[5] == pytest.approx(-2.0 * drone.gravity)
    assert np.delete(fall, 5) == pytest.approx(0.0, abs=1e-14)
    # Drag balances the fall at the terminal speed, ρ √(v² + v₀²) v = 2 m g.
    square, weight = drone.slow_speed**2, 2.0 * drone.mass * drone.gravity / drone.drag
    over[5] = -np.sqrt((np.sqrt(square**2 + 4.0 * weight**2) - square) / 2.0)
    assert drone.derivative(over, np.zeros(4))[5] == pytest.approx(0.0, abs=1e-12)


def test_euler_steps_keep_the_norm_of_the_quaternion() -> None:
    drone = Drone()
    inputs = np.random.default_rng(0).normal(size=(50, 8, 4)).repeat(10, axis=0)
    inputs /= np.linalg.norm(inputs, axis=-1, keepdims=True)
    path = simulate(drone, drone.gamma * inputs)
    assert np.abs(path[..., 10:]).max() > 2.0, "it turns"
    assert np.linalg.norm(path[..., 6:10], axis=-1) == pytest.approx(1.0, abs=0.01)


Function = Callable[[Any], Any]

FUNCTIONS: dict[str, Function] = {
    "sin": sin,
    "cos": cos,
    "tanh": tanh,
    "magnitude": magnitude,
    "sign": sign,
    "where": lambda x: where(x > 0, 2.0 * x, x * x),
    "where with constants": lambda x: where(x > 0.5, 1.0, -3.0),
    "where at most": lambda x: where(x <= 0.5, x, -x),
}
POINTS = (-1.3, -0.2, 0.4, 2.0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arrays_and_tensors_agree_with_numbers(name: str) -> None:
    function = FUNCTIONS[name]
    numbers = [function(x) for x in POINTS]
    assert all(isinstance(number, float) for number in numbers)
    np.testing.assert_allclose(function(np.array(POINTS)), numbers, rtol=1e-15)
    tensor = function(torch.tensor(POINTS, dtype=torch.float64))
    np.testing.assert_allclose(tensor.numpy(), numbers, rtol=1e-15)


def slope(function: Function, x: float) -> float:
    return float((function(x + 1e-6) - function(x - 1e-6)) / 2e-6)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_complex_step_takes_the_derivative(name: str) -> None:
    function, step = FUNCTIONS[name], 1e-30
    for x in POINTS:
        for value in (np.complex128(x + 1j * step), np.array([x + 1j * step])):
            found = np.asarray(function(value)).imag / step
            assert float(np.ravel(found)[0]) == pytest.approx(slope(function, x), abs=1e-8)
    assert sign(0.0) == sign(np.complex128(0.0 + 1e-30j)) == 0.0
    assert math.isnan(sign(math.nan))


FRICTION: dict[str, Callable[[Any, Any], Any]] = {
    "sign": lambda state, parameters: (-parameters[3] * sign(state[1]) - sin(state[0]),),
    "where": lambda state, parameters: (where(state[1] > 0, -parameters[3], 2.0 * state[1]),),
    "product": lambda state, parameters: ((state[1] > 0) * -parameters[3] - state[1],),
}


@pytest.mark.parametrize("name", FRICTION)
def test_dry_friction_is_compiled_with_its_derivative(name: str) -> None:
    system, out = broken_system(accelerations=FRICTION[name]), np.empty(1)
    check_system(system)
    equations, parameters = compiled_equations(system), np.array(system.parameters)
    slopes = np.empty(1, complex)
    for rate in (-0.7, 0.3):
        state = np.array([0.5, rate])
        equations.accelerations(state, parameters, out)
        expected = system.accelerations(tuple(state), system.parameters)
        np.testing.assert_allclose(out, expected, rtol=1e-14)
        equations.complex_accelerations(state + 1e-30j * np.eye(2)[1], parameters + 0j, slopes)
        ahead, behind = (
            system.accelerations((0.5, rate + h), system.parameters)[0] for h in (1e-6, -1e-6)
        )
        assert slopes[0].imag / 1e-30 == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)


@pytest.mark.parametrize(
    "function", [lambda state, *_: (-np.sign(state[1]),), lambda state, *_: (-abs(state[1]),)]
)
def test_a_wrong_derivative_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(SpecificationError, match="use sign, where and magnitude") as caught:
        check_system(broken_system(accelerations=function))
    assert "\n" not in str(caught.value)


def unknown_to_the_compiler(state: Any, parameters: Any) -> tuple[Any, ...]:  # noqa: ARG001
    return (sum({"rate": -state[1]}.values()),)


def test_equations_that_do_not_compile_are_refused_in_a_sentence() -> None:
    system = broken_system(accelerations=unknown_to_the_compiler)
    check_system(system)
    with pytest.raises(SpecificationError, match="does not compile") as caught:
        compiled_equations(system)
    message = str(caught.value)
    assert "unknown_to_the_compiler of test_each.py" in message
    assert "\n" not in message
    assert len(message) < 500


def damped_mass(star: MovingStar, friction: float, dt: float, forces: np.ndarray) -> np.ndarray:
    """Return the positions of a mass of 1 kg, q̈ = F + u - α q̇, by the Euler map."""
    at, velocity = np.array(star.initial_state), np.zeros(2)
    positions = [at]
    for t, force in enumerate(forces):
        push = star.friction * star.learned(at[None], t)[0]
        at, velocity = at + dt * velocity, velocity + dt * (push + force - friction * velocity)
        positions.append(at)
    return np.array(positions)


def test_a_step_is_that_of_the_mass_in_flex_one_step_earlier() -> None:
    """With α dt = 1 a velocity has no memory. Their force is that where the mass was before."""
    star = MovingStar(period=1e6, horizon=60)
    rng = np.random.default_rng(0)
    forces = 50.0 * rng.normal(size=(60, 2))
    expected = damped_mass(star, friction=100.0, dt=0.01, forces=forces)
    at = np.array(star.initial_state)
    for t, force in enumerate(forces):
        assert at == pytest.approx(expected[t + 1], abs=1e-4)
        at = at + star.dt * star.derivative(at, force, t)
    assert np.linalg.norm(at - np.array(star.initial_state)) > 0.02


def test_the_force_points_away_from_the_star_and_falls_to_half_at_its_radius() -> None:
    star = MovingStar(radius=0.3, strength=2.0, friction=4.0, core=1e-6)
    centre = np.array([star.orbit, 0.0])
    for angle in (0.3, 2.0, 5.0):
        away = np.array([np.cos(angle), np.sin(angle)])
        near, far = (star.learned((centre + s * away)[None])[0] for s in (1e-3, 0.3))
        assert near == pytest.approx(2.0 / 4.0 * away, rel=1e-4)
        assert far == pytest.approx(1.0 / 4.0 * away, rel=1e-4)
    assert star.learned(centre[None])[0] == pytest.approx(0.0)


def test_the_star_goes_round_once_in_a_period() -> None:
    star = MovingStar(period=0.02, dt=1e-4, horizon=401, orbit=0.7)
    places = [star.physical.index(name) for name in ("center_x", "center_y")]
    path = star.history[:, places]
    assert np.linalg.norm(path, axis=1) == pytest.approx(0.7)
    for turned in (path[200], path[400]):
        assert turned == pytest.approx(path[0])
    assert path[50] == pytest.approx([0.0, 0.7], abs=1e-12)
    assert star.history[0] == pytest.approx(star.parameters)


@pytest.mark.parametrize("start", [0.05, 4.0])
def test_free_motions_tend_to_the_cycle_of_the_textbook(start: float) -> None:
    """With μ = ω₀ it has the amplitude 2.009 a and the period 6.663 / ω₀."""
    system = VanDerPol(amplitude=0.5, damping=2.0, stiffness=4.0, dt=1e-3)
    system = dataclasses.replace(system, initial_state=(start * 0.5, 0.0))
    path = simulate(system, np.zeros((20_000, 1, 1)))[10_000:, 0, 0]
    assert path.max() == pytest.approx(0.5 * 2.009, rel=2e-3)
    upwards = np.flatnonzero((path[:-1] < 0) & (path[1:] >= 0))
    assert np.diff(upwards).mean() * system.dt == pytest.approx(6.663 / 2.0, rel=5e-3)


def states(system: System, n: int = 50) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=2.0, size=(n, system.n_states))


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_shipped_system_has_a_body_of_rigid_rods_and_level_springs(name: str) -> None:
    system = SYSTEMS[name]()
    *lines, masses = body(system, states(system))
    assert lines
    assert masses.shape[::2] == (50, 2)
    for line in lines:
        lengths = np.linalg.norm(np.diff(line, axis=1), axis=-1)
        if line[..., 1].any():
            np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape))


@pytest.mark.parametrize(
    ("system", "at", "masses"),
    [
        (Pendulum(length=2.0), [[0.0, 0], [np.pi / 2, 0]], [[[0, -2]], [[2, 0]]]),
        (Cartpole(), [[1.0, 0, 0, 0], [1.0, 0, np.pi / 2, 0]], [[[1, 1]], [[2, 0]]]),
        (Arm(), [[np.pi / 2, 0, 0.0, 0]], [[[1, 0], [1, -1]]]),
        (
            MassSpring(),
            [[0.0, 1, 0, 2], [0.5, 0, -0.5, 0]],
            [[[0, 0], [2, 0]], [[0.5, 0], [1.5, 0]]],
        ),
    ],
)
def test_masses_are_drawn_where_they_are(system: System, at: Any, masses: Any) -> None:
    """A pendulum hangs at rest, a pole stands, and the links of an arm have absolute angles."""
    np.testing.assert_allclose(body(system, np.array(at))[-1], masses, atol=1e-12)


def test_a_quadrotor_tilts_its_right_side_up() -> None:
    bar, mass = body(Quadrotor(), np.array([[3.0, 0, 4.0, 0, 0.1, 0]]))
    assert bar[0, 2, 1] > 4.0 > bar[0, 1, 1]
    np.testing.assert_allclose(bar[0].mean(axis=0), [3, 4])
    np.testing.assert_allclose(mass[0], [[3, 4]])
