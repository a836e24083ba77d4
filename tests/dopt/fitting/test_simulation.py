"""Simulated windows against an independent integrator, and sensitivities against differences."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dopt
from dopt.fitting.model import Layout, Model, data_of
from dopt.fitting.problem import Simulator, Windows, first_states, solve, windows_of
from dopt.types import Array


def pendulum(**changed: object) -> dopt.Plant:
    given: dict[str, object] = {
        "states": {"angle": "rad", "rate": "rad/s"},
        "inputs": {"voltage": "V"},
        "dt": 0.02,
        "gamma": 3.0,
        "known": {
            "angle": "rate",
            "rate": "gain * voltage - damping * rate - gravity * sin(angle + offset)",
        },
        "constants": {
            "gain": dopt.unknown(20.0),
            "damping": dopt.unknown(1.0),
            "gravity": dopt.unknown(40.0),
            "offset": dopt.unknown(0.0, spread=0.2),
        },
        "learned": ["rate"],
        "angles": ["angle"],
        "box": {"rate": 10.0},
        "measured": {"angle": 0.01, "rate": 0.1},
    }
    return dopt.Plant(**(given | changed))  # type: ignore[arg-type]


def stamps(rng: np.random.Generator, n: int, jitter: float) -> Array:
    return np.cumsum(0.02 * (1 + jitter * rng.uniform(-1, 1, n)))


def truth(t: Array, u: Array, delay: float, lag: float, x0: Array, c: tuple[float, ...]) -> Array:
    """Simulate with SciPy, from one switch of the input to the next."""
    gain, damping, gravity, offset = c

    def held(s: float) -> float:
        at = int(np.searchsorted(t + delay, s, side="right")) - 1
        return float(u[max(at, 0)])

    def rate(_: float, x: Array, now: float) -> list[float]:
        v = x[2] if lag else now
        force = gain * v - damping * x[1] - gravity * math.sin(x[0] + offset)
        return [x[1], force, (now - x[2]) / lag if lag else 0.0]

    switches = sorted({*t, *(t + delay)[(t + delay > t[0]) & (t + delay < t[-1])]})
    x, out = np.array([*x0, held(t[0] + 1e-12)]), {switches[0]: np.array(x0)}
    for a, b in itertools.pairwise(switches):
        now = held(0.5 * (a + b))
        x = solve_ivp(rate, (a, b), x, args=(now,), rtol=1e-10, atol=1e-12).y[:, -1]
        out[b] = x[:2]
    return np.array([out[s] for s in t])


def simulator(
    plant: dopt.Plant, t: Array, y: Array, u: Array, hold: str = "zero", **how: object
) -> Simulator:
    log = dopt.Log(
        {"t": t, "angle": y[:, 0], "rate": y[:, 1], "voltage": u},
        states=["angle", "rate"],
        inputs=["voltage"],
        angles=["angle"],
    )
    return Simulator(Model(plant, **how), data_of(plant, [log], hold))  # type: ignore[arg-type]


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.parametrize(
    ("delay", "lag"), [(0, 0), (0.02, 0), (0.031, 0), (-0.013, 0), (0, 0.05), (0.027, 0.03)]
)
def test_a_simulation_agrees_with_scipy(delay: float, lag: float, jitter: float) -> None:
    rng = np.random.default_rng(int(1e3 * (delay + lag + jitter)) + 100)
    t, u = stamps(rng, 120, jitter), rng.uniform(-2, 2, 120)
    if lag:
        u[:8] = u[0]  # the actuator has settled where the log begins
    expected = truth(t, u, delay, lag, np.array([0.3, -0.5]), (20.0, 1.0, 40.0, 0.0))
    sim = simulator(pendulum(lag=lag), t, expected, u, delay=delay, longest_step=0.002)
    found = sim.states(sim.model.prior, 5, 110, expected[5])
    np.testing.assert_allclose(found, expected[5:111], rtol=0, atol=2e-7)


@pytest.mark.parametrize("width", [0, 5])
@pytest.mark.parametrize("seed", range(3))
def test_sensitivities_agree_with_differences(width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, u = stamps(rng, 60, 0.3), rng.uniform(-2, 2, 60)
    plant = pendulum(delay=dopt.unknown(0.0, spread=0.02), lag=dopt.unknown(0.03))
    layout = Layout(np.array([0.0, 0.0, 0.5]), np.array([1.0, 1.0, 4.0]), np.array([9.0]))
    how: dict[str, Any] = {
        "longest_step": 0.002,
        "delay": 0.0303,
        "free_delay": True,
        "free_lag": True,
        "width": width,
    }
    sim = simulator(plant, t, np.zeros((60, 2)), u, layout=layout, **how)
    p = sim.model.prior + 0.3 * rng.standard_normal(sim.model.q)
    start = np.array([0.4, 1.0])
    states, S = sim.slopes(p, 6, 50, start)
    np.testing.assert_allclose(states, sim.states(p, 6, 50, start), rtol=0, atol=1e-12)
    h = 1e-5
    for j in range(sim.model.q + 2):
        ahead, behind = (p.copy(), start.copy()), (p.copy(), start.copy())
        for (parameters, state), sign in ((ahead, 1), (behind, -1)):
            into, at = (parameters, j) if j < sim.model.q else (state, j - sim.model.q)
            into[at] += sign * h
        slope = (
            sim.states(ahead[0], 6, 50, ahead[1]) - sim.states(behind[0], 6, 50, behind[1])
        ) / (2 * h)
        np.testing.assert_allclose(S[:, :, j], slope, rtol=2e-4, atol=2e-5 * np.abs(slope).max())


def test_elimination_gives_the_step_of_the_whole_problem() -> None:
    rng = np.random.default_rng(3)
    t, u = stamps(rng, 200, 0.0), rng.uniform(-2, 2, 200)
    y = truth(t, u, 0, 0, np.array([0.2, 0.0]), (22.0, 1.3, 35.0, 0.1))
    sim = simulator(pendulum(), t, y + 0.01 * rng.standard_normal(y.shape), u)
    data, model = sim.data, sim.model
    rows = windows_of(data, 0, 199, 0.5, skip=0.0, ahead=0.0)
    windows = Windows(rows, first_states(data, model, rows))
    weights = rng.uniform(0.5, 2.0, len(rows))
    linear = sim.linear(model.prior, windows, weights)
    q, d, blocks, right = model.q, model.d, [], []
    for k, (first, last) in enumerate(rows):
        states, S = sim.slopes(model.prior, first, last, windows.starts[k])
        scaled = S.reshape(-1, q + d) / np.tile(data.deviations, last - first + 1)[:, None]
        block = np.zeros((len(scaled), q + d * len(rows)))
        block[:, :q] = scaled[:, :q]
        block[:, q + d * k : q + d * (k + 1)] = scaled[:, q:]
        error = ((data.measured[first : last + 1] - states) / data.deviations).ravel()
        blocks.append(np.sqrt(weights[k]) * block)
        right.append(np.sqrt(weights[k]) * error)
    whole = np.linalg.lstsq(np.concatenate(blocks), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(linear.normal, linear.slope), whole[:q], rtol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_fit_finds_constants_delay_and_lag(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, u = stamps(rng, 1500, 0.2), np.repeat(rng.uniform(-2, 2, 250), 6)
    c, delay, lag = (24.0, 1.4, 33.0, 0.1), 0.013, 0.06
    y = truth(t, u, delay, lag, np.array([0.0, 0.0]), c)
    noisy = y + rng.standard_normal(y.shape) * [0.002, 0.02]
    plant = pendulum(
        measured={"angle": 0.002, "rate": 0.02},
        delay=dopt.unknown(0.0, spread=0.02),
        lag=dopt.unknown(0.04),
    )
    sim = simulator(plant, t, noisy, u, free_delay=True, free_lag=True)
    rows = windows_of(sim.data, 0, 1499, 0.6, skip=0.1, ahead=0.05)
    windows = Windows(rows, first_states(sim.data, sim.model, rows))
    found = solve(sim, windows, sim.model.prior, 1.0)
    values, _ = sim.model.named_values(found.p)
    expected = dict(
        zip(("gain", "damping", "gravity", "offset", "delay", "lag"), (*c, delay, lag), strict=True)
    )
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, rel=0.03, abs=0.003), name


def test_an_input_that_was_measured_is_interpolated() -> None:
    t: Array = np.arange(100.0) * 0.02
    u = np.sin(3 * t)
    plant = pendulum()

    def rate(s: float, x: Array) -> list[float]:
        return [x[1], 20 * np.interp(s, t, u) - x[1] - 40 * math.sin(x[0])]

    expected = solve_ivp(rate, (0, t[-1]), [0.1, 0.0], t_eval=t, rtol=1e-10, atol=1e-12).y.T
    held, linear = (simulator(plant, t, expected, u, hold) for hold in ("zero", "linear"))
    one = held.states(held.model.prior, 0, 99, expected[0])
    other = linear.states(linear.model.prior, 0, len(linear.data.time) - 1, expected[0])
    seen = np.isfinite(linear.data.measured[:, 0])
    np.testing.assert_array_equal(linear.data.measured[seen], expected)
    assert np.abs(other[seen] - expected).max() < 0.01 * np.abs(one - expected).max()


def test_a_simulation_that_leaves_the_limit_counts_and_fails_nothing() -> None:
    t: Array = np.arange(100.0) * 0.02
    rng = np.random.default_rng(0)
    plant = pendulum(
        known={"angle": "rate", "rate": "gain * voltage + gravity ** 2 * angle"}, limit=50.0
    )
    sim = simulator(plant, t, np.ones((100, 2)), rng.uniform(-1, 1, 100))
    windows = Windows(np.array([[0, 60]]), np.array([[1.0, 0.0]]))
    assert sim.squares(sim.model.prior, windows) == np.inf
    found = solve(sim, windows, sim.model.prior, 1.0, most=3)
    assert np.isfinite(found.p).all()
