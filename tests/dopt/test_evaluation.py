from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter

import numpy as np
import pytest

from dopt.evaluation import (
    _SEED,
    LONGEST_RUN,
    evaluation_set,
    reachable_states,
    simulate,
    visited_points,
)
from dopt.policies import PeriodicSquare
from dopt.randomness import draw
from dopt.spec.config import REACHABLE_VERSION
from dopt.systems import SYSTEMS, Pendulum, Quadrotor
from dopt.systems.properties import eigenmode
from tests.dopt.trials import trial

NAMES = sorted(SYSTEMS)


@pytest.mark.parametrize("name", NAMES)
def test_reachable_states_are_a_function_of_the_system_alone(name: str) -> None:
    system = SYSTEMS[name]()
    first = reachable_states(system)
    np.random.standard_normal(3)  # noqa: NPY002  # the state that everything may share
    assert np.array_equal(first, reachable_states(dataclasses.replace(system)))
    quiet = dataclasses.replace(system, noise=0.0, grid_points=(1,) * len(system.grid_points))
    assert np.array_equal(first, reachable_states(quiet))
    assert first.shape == (512, system.n_states)


def test_a_long_horizon_adds_no_runs_and_is_part_of_the_key_of_a_trial() -> None:
    longest, longer = Pendulum(horizon=LONGEST_RUN), Pendulum(horizon=50 * LONGEST_RUN)
    assert np.array_equal(reachable_states(longest), reachable_states(longer))
    keys = [trial("pendulum", "random", env={"horizon": s.horizon}) for s in (longest, longer)]
    versions = [json.loads(spec.config_json).get("reachable_version") for spec in keys]
    assert versions == [None, REACHABLE_VERSION]


@pytest.mark.parametrize("name", NAMES)
def test_no_visited_state_is_drawn_twice(name: str) -> None:
    """The sample has a state at most as often as the runs, some of which begin alike."""
    system = SYSTEMS[name]()
    visited, _ = visited_points(system, np.random.default_rng(_SEED))
    visits = Counter(map(tuple, visited.tolist()))
    sample = Counter(map(tuple, reachable_states(system).tolist()))
    assert sample <= visits


@pytest.mark.parametrize("name", NAMES)
def test_reachable_states_are_wider_than_what_white_noise_visits(name: str) -> None:
    spec = trial(name, "random_sphere", env={"horizon": 500})
    white = simulate(spec.system, draw(spec).inputs[:, None, :])[:, 0]
    plane = list(spec.system.phase_plane)
    reached = reachable_states(spec.system)[:, plane]
    assert np.all(np.ptp(reached, axis=0) > np.ptp(white[:, plane], axis=0))


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "arm"])
def test_the_reachable_set_has_states_that_the_square_wave_visits(name: str) -> None:
    """One of its eight sequences is that of the policy, but for steps where the sine is zero."""
    system = SYSTEMS[name]()
    mode = eigenmode(system)
    assert mode is not None
    inputs = PeriodicSquare().inputs(system, np.random.default_rng(0))
    inputs[np.sin(mode.frequency * system.dt * np.arange(len(inputs))) == 0.0] = 0.0
    wave = simulate(system, inputs[:, None])[1:, 0]
    reached = {state.tobytes() for state in reachable_states(system)}
    shared = sum(state.tobytes() in reached for state in wave)
    assert 0.05 * len(reached) < shared < 0.25 * len(reached)


def test_a_pendulum_is_never_faster_than_its_terminal_speed() -> None:
    pendulum = Pendulum(gamma=4.0)
    weight = pendulum.mass * pendulum.gravity * pendulum.length / 2
    terminal = (pendulum.gamma + weight) / pendulum.friction
    speeds = np.abs(reachable_states(pendulum)[:, 1])
    assert 1.0 < speeds.max() <= terminal


def test_a_quadrotor_is_never_faster_than_its_terminal_speed() -> None:
    quadrotor = Quadrotor()
    thrust = math.sqrt(2.0) * quadrotor.gamma + quadrotor.mass * quadrotor.gravity
    speeds = np.abs(reachable_states(quadrotor)[:, [1, 3]])
    assert 1.0 < speeds.max() <= math.sqrt(thrust / quadrotor.drag)


@pytest.mark.parametrize("name", NAMES)
def test_a_simulated_step_is_the_euler_map(name: str) -> None:
    system = dataclasses.replace(SYSTEMS[name](), horizon=5)
    inputs = np.random.default_rng(0).standard_normal((5, 3, system.n_inputs))
    path = simulate(system, inputs)
    for t in range(5):
        for i in range(3):
            step = system.dt * system.derivative(path[t, i], inputs[t, i], t)
            assert path[t + 1, i] == pytest.approx(path[t, i] + step, rel=1e-13, abs=1e-15)


@pytest.mark.parametrize("name", NAMES)
def test_the_truth_at_the_points_is_that_of_the_system(name: str) -> None:
    system = SYSTEMS[name]()
    points = evaluation_set(system)
    assert points.n_grid == math.prod(system.grid_points)
    assert np.array_equal(points.states[: points.n_grid], system.grid())
    rows = list(system.learned_rows)
    known = np.array(
        [
            system.derivative(x, u)[rows]
            - np.array(system.known(tuple(x), tuple(u), system.parameters))[rows]
            for x, u in zip(points.states[::50], points.inputs[::50], strict=True)
        ]
    )
    assert points.accelerations[::50] == pytest.approx(known, rel=1e-10, abs=1e-9)


def test_a_step_too_long_for_the_system_warns_of_nothing() -> None:
    """States that overflow are left out, without a warning on the way (warnings are errors)."""
    wild = Pendulum(dt=50.0, horizon=400)
    assert np.isfinite(evaluation_set(wild).states).all()


def test_no_state_within_the_limit_leaves_the_grid_alone() -> None:
    points = evaluation_set(Pendulum(state_limit=1e-9, initial_state=(1.0, 0.0)))
    assert len(points.states) == points.n_grid
