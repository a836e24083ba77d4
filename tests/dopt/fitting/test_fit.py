"""Simulations of a fit against SciPy, and fits of a plant: constants, delay, lag and network."""

from __future__ import annotations

import dataclasses
import itertools
import math
import pickle
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import dopt
from dopt.errors import SpecificationError
from dopt.fitting import problem
from dopt.fitting.fit import same_rows
from dopt.fitting.fitted import Fitted
from dopt.fitting.model import Layout, Model, data_of
from dopt.fitting.problem import Simulator, Windows, first_states, solve, windows_of
from dopt.types import Array
from tests.paths import EXAMPLE, loaded


def pendulum(**changed: object) -> dopt.Plant:
    torque = "gain * voltage - damping * rate - gravity * sin(angle + offset)"
    given: dict[str, object] = {
        "states": {"angle": "rad", "rate": "rad/s"},
        "inputs": {"voltage": "V"},
        "dt": 0.02,
        "gamma": 3.0,
        "known": {"angle": "rate", "rate": torque},
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


def truth(
    t: Array, u: Array, delay: float, lag: float, x0: Array, c: tuple[float, ...], drag: float = 0.0
) -> Array:
    """Simulate with SciPy, from one switch of the input to the next.

    The plant declares no quadratic drag.
    """
    gain, damping, gravity, offset = c

    def held(s: float) -> float:
        at = int(np.searchsorted(t + delay, s, side="right")) - 1
        return float(u[max(at, 0)])

    def rate(_: float, x: Array, now: float) -> list[float]:
        v = x[2] if lag else now
        force = gain * v - damping * x[1] - gravity * math.sin(x[0] + offset)
        force -= drag * x[1] * abs(x[1])
        return [x[1], force, (now - x[2]) / lag if lag else 0.0]

    switches = sorted({*t, *(t + delay)[(t + delay > t[0]) & (t + delay < t[-1])]})
    x, out = np.array([*x0, held(t[0] + 1e-12)]), {switches[0]: np.array(x0)}
    for a, b in itertools.pairwise(switches):
        now = held(0.5 * (a + b))
        how: dict[str, Any] = {"args": (now,), "method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
        x = solve_ivp(rate, (a, b), x, **how).y[:, -1]
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
    plant = pendulum(delay=dopt.unknown(0.0303, spread=0.02), lag=dopt.unknown(0.03))
    layout = Layout(np.array([0.0, 0.0, 0.5]), np.array([1.0, 1.0, 4.0]), np.array([9.0]))
    how: dict[str, Any] = {"longest_step": 0.002, "width": width, "layout": layout}
    sim = simulator(plant, t, np.zeros((60, 2)), u, **how)
    q, h = sim.model.q, 1e-5
    at = np.concatenate([sim.model.prior + 0.3 * rng.standard_normal(q), [0.4, 1.0]])

    def states(both: Array) -> Array:
        return sim.states(both[:q], 6, 50, both[q:])

    found, S = sim.slopes(at[:q], 6, 50, at[q:])
    np.testing.assert_allclose(found, states(at), rtol=0, atol=1e-12)
    for j, move in enumerate(h * np.eye(q + 2)):
        slope = (states(at + move) - states(at - move)) / (2 * h)
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


def badly_begun(seed: int) -> tuple[Simulator, Windows, float]:
    """Return a noisy run with drag, windows of up to four seconds, and starts far from it."""
    rng = np.random.default_rng(seed)
    table = run(seed, 600, drag=rng.uniform(0, 0.6))
    table["angle"] += 0.01 * rng.standard_normal(len(table))
    guesses = [value * np.exp(rng.normal()) for value in TRUE[:3]]
    constants = {
        **dict(zip(("gain", "damping", "gravity"), map(dopt.unknown, guesses), strict=True)),
        "offset": dopt.unknown(0.0, spread=0.2),
    }
    plant = declared(measured={"angle": 0.01}, delay=0.02, constants=constants)
    data = data_of(plant, [dopt.Log.for_plant(table, plant)], "zero")
    model = Model(plant, delay=0.02)
    rows = windows_of(data, 0, 599, float(rng.choice([0.4, 0.8, 2.0, 4.0])), skip=0.1, ahead=0.05)
    starts = first_states(data, model, rows)
    starts += rng.normal(size=starts.shape) * [0.3, 2.0]
    return Simulator(model, data), Windows(rows, starts), float(rng.choice([1.0, 3.0]))


def cost(sim: Simulator, found: problem.Solution, s: float) -> float:
    prior = np.sum((found.p - sim.model.prior) ** 2)
    return float(problem.robust(found.squares, found.scale).sum() / s**2 + prior)


def test_what_has_converged_gains_nothing_from_another_beginning() -> None:
    """A window whose start steps too far holds up no other: five of these fits were stuck."""
    for seed in range(40):
        sim, windows, s = badly_begun(seed)
        found = solve(sim, windows, sim.model.prior, s)
        settled = sim.settled(found.p, found.windows)
        again = solve(sim, settled, found.p, s, scale=found.scale)
        assert found.converged or found.steps == 30, "it still falls where its steps end"
        assert not found.converged or cost(sim, again, s) > 0.98 * cost(sim, found, s), seed


def test_a_fit_that_may_not_step_converges_at_a_minimum_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sim, windows, s = badly_begun(0)
    found = solve(sim, windows, sim.model.prior, s, tolerance=1e-9)
    monkeypatch.setattr(problem, "LARGEST_DAMPING", 0.0)
    stuck = solve(sim, windows, sim.model.prior, s)
    assert (stuck.steps, stuck.converged) == (1, False)
    again = solve(sim, found.windows, found.p, s, scale=found.scale)
    assert (again.steps, again.converged) == (1, True)
    starts = found.windows.starts + 0.01
    moved = solve(sim, found.windows._replace(starts=starts), found.p, s, scale=found.scale)
    assert not moved.converged, "its starts could fall"


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


@pytest.mark.parametrize(("hold", "other"), [("zero", "linear"), ("linear", "cubic")])
def test_rows_have_the_same_times_where_inputs_are_interpolated(hold: str, other: str) -> None:
    rng = np.random.default_rng(0)
    lengths = [5] * 60 + [2, 17, 40]
    t = np.concatenate([10.0 * k + 0.02 * np.arange(n) for k, n in enumerate(lengths)])
    columns = {name: rng.normal(size=len(t)) for name in ("angle", "rate", "voltage")}
    log = dopt.Log(
        {"t": t, **columns}, states=["angle", "rate"], inputs=["voltage"], angles=["angle"]
    )
    data, finer = (data_of(pendulum(), [log], one) for one in (hold, other))
    rows = np.flatnonzero(np.isfinite(data.measured[:, 0])).reshape(-1, 1)
    moved = same_rows(rows, data, finer)
    np.testing.assert_array_equal(finer.measured[moved], data.measured[rows])


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


TRUE = (24.0, 1.4, 33.0, 0.1)


def run(
    seed: int, n: int = 1200, *, drag: float = 0.0, lag: float = 0.0, counts: int = 4096
) -> pd.DataFrame:
    """Return a run whose angle is measured in steps of a turn of so many counts."""
    rng = np.random.default_rng(seed)
    t, u = stamps(rng, n, 0.0), np.repeat(rng.uniform(-2.5, 2.5, n // 6), 6)
    x = truth(t, u, 0.02, lag, np.zeros(2), TRUE, drag)
    quantum = 2 * math.pi / counts
    return pd.DataFrame({"time": t, "angle": np.round(x[:, 0] / quantum) * quantum, "voltage": u})


def declared(**changed: object) -> dopt.Plant:
    measured = {"angle": dopt.encoder(4096)}
    return pendulum(**{"measured": measured, "delay": dopt.unknown(0.0, spread=0.02), **changed})


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """Return a fit to a run with drag, whose network the validation wants."""
    return dopt.fit(declared(), run(0, drag=0.4), width=6, weights=(10.0, 3.0))


@pytest.mark.parametrize("seed", range(2))
def test_constants_and_delay_lie_within_their_errors(seed: int) -> None:
    found = dopt.fit(declared(), run(seed), width=0)
    expected = dict(
        zip(("gain", "damping", "gravity", "offset", "delay"), (*TRUE, 0.02), strict=True)
    )
    for name, value in expected.items():
        estimate, error = found.constants[name]
        assert abs(estimate - value) < 5 * error + 2e-3 * abs(value), (name, estimate, error)
    assert not found.has_network
    assert "fits better, and moves" not in found.report()


def test_standard_errors_are_of_fits_without_each_window() -> None:
    """From the residuals at the minimum alone, 90 of 100 intervals of 95 % held the truth."""
    found = dopt.fit(declared(), run(3, 402), width=0, window=0.6)
    model, (p, windows, _, scale, *_), _, covariance = found.physics
    others = ~np.eye(len(scale), dtype=bool)
    assert len(scale) < 15
    simulator = Simulator(model, found.data)
    left_out = [
        solve(simulator, windows.where(one), p, 1.0, scale=scale[one], tolerance=1e-8).p
        for one in others
    ]
    squares = np.sum(np.square(np.array(left_out) - p), axis=0)
    np.testing.assert_allclose(np.diag(covariance), squares, rtol=0.01)


@pytest.mark.parametrize("supply", [1.7, math.inf])
def test_a_supply_that_is_not_declared_is_found(
    supply: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is cut is seen where the effect of the input is known."""
    clock = iter(range(99))
    ticks = SimpleNamespace(perf_counter=lambda: float(next(clock)))
    monkeypatch.setattr("dopt.fitting.fit.time", ticks)
    plant, table = declared(), run(2)
    constants = {**plant.constants, "gain": TRUE[0]}
    t, u = (table[name].to_numpy() for name in ("time", "voltage"))
    x = truth(t, np.clip(u, -supply, supply), 0.02, 0.0, np.zeros(2), TRUE)
    found = dopt.fit(
        dataclasses.replace(plant, constants=constants), table.assign(angle=x[:, 0]), width=0
    )
    assert found.plant.supply == pytest.approx(supply, rel=0.002)
    assert ("inputs beyond" in found.report()) == (supply < math.inf)
    assert found.selection.seconds == next(clock) - 1, "from the first fit to the last"


def test_a_network_is_refused_where_the_constants_tell_all() -> None:
    found = dopt.fit(declared(), run(5), width=6, weights=(10.0,))
    assert not found.has_network
    report = found.report()
    (constants, network) = (
        min(loss for what, loss, _ in found.selection.table if what.startswith(begin))
        for begin in ("constants", "and 6 units")
    )
    (changed,) = re.findall(r"no network: .* changes by ([+-][\d.]+) ± ", report)
    assert float(changed) == pytest.approx(network - constants, abs=1e-3)
    assert "lack something" not in report
    assert "-0.00" not in report
    assert report.count("physics alone") == 1, "it is the model"
    assert [row["model"] for row in found.errors()[:1]] == ["model"], "what is used comes first"


def test_a_network_is_kept_where_something_is_not_declared(fitted: Fitted) -> None:
    assert fitted.has_network
    assert "The equations lack something" in fitted.report()
    rows = [row for row in fitted.errors() if row["horizon"] == max(fitted.horizons[:3])]
    by_model = {row["model"]: row["rms"] for row in rows}
    assert by_model["model"] < 0.7 * by_model["physics alone"] < by_model["linear"]
    assert fitted.verdict().startswith("Useful up to")
    [row, *_] = [row for row in fitted.errors() if row["model"] == "model"]
    report = fitted.report()
    assert f"median of the model {row['median']:.3g}\n" in report
    assert f"s, {row['windows']} predictions: model {row['rms']:.3g}, physics alone" in report


def test_bounds_hold_what_they_say_on_another_run(fitted: Fitted) -> None:
    other = dopt.Log.for_plant(run(9, drag=0.4), fitted.plant)
    simulated = fitted.simulate(other, level=0.9)[0]
    measured = other.pieces[0].measured[-len(simulated.time) :, 0]
    later = simulated.time > simulated.time[0] + fitted.selection.window
    inside = (measured >= simulated.lower[:, 0]) & (measured <= simulated.upper[:, 0])
    assert 0.75 <= inside[later].mean() <= 1.0
    assert 0.8 <= fitted.coverage(0.9)["angle"] <= 0.98
    read_back = pickle.loads(pickle.dumps(fitted))
    assert read_back.report() == fitted.report()
    np.testing.assert_array_equal(read_back.simulate(other)[0].lower, simulated.lower)


@pytest.mark.parametrize("blocks", [1, 2, 5])
def test_bounds_are_wide_where_predictions_diverge(fitted: Fitted, blocks: int) -> None:
    """An endless error by an endless one that is expected is no number."""
    found = pickle.loads(pickle.dumps(fitted))
    vars(found).pop("_ratios", None)
    for part in found._held_out["model"][:blocks]:
        for errors in part.errors:
            errors[len(errors) // 2 :] = np.inf
    simulated = found.simulate(dopt.Log.for_plant(run(9, 300, drag=0.4), fitted.plant))[0]
    assert (simulated.lower < simulated.upper).all()
    assert found.coverage()["angle"] <= fitted.coverage()["angle"]
    assert "angle" in found.report()


def test_a_saved_model_needs_numpy_alone(fitted: Fitted, tmp_path: Path) -> None:
    fitted.save(tmp_path / "model_0.5s")  # no ending of a name is lost
    derivative, step = loaded(EXAMPLE / "load_model.py").load(tmp_path / "model_0.5s.npz")
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(50, 2)) * [2.0, 8.0], rng.normal(size=(50, 1))
    expected = fitted.predict(x, u)
    found = [derivative(*at) for at in zip(x, u, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    reached = step(x[0], u[0], 1e-4)
    np.testing.assert_allclose((reached - x[0]) / 1e-4, expected[0], rtol=1e-2)
    with pytest.raises(SpecificationError, match=r"give the URL to store\(\)"):
        fitted.save("sqlite:///results.db")


def test_the_module_of_torch_gives_the_same_derivatives(fitted: Fitted) -> None:
    import torch

    rng = np.random.default_rng(2)
    x, u = rng.normal(size=(20, 2)) * [2.0, 8.0], rng.normal(size=(20, 1))
    module = fitted.to_torch()
    found = module(torch.tensor(x), torch.tensor(u))
    np.testing.assert_allclose(found.detach().numpy(), fitted.predict(x, u), rtol=1e-9)
    found.sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())


def test_the_environment_goes_as_the_simulation(fitted: Fitted) -> None:
    pytest.importorskip("gymnasium")
    table = run(4, 120, drag=0.4)
    log = dopt.Log.for_plant(table, fitted.plant)
    simulated = fitted.simulate(log)[0]
    env, at = fitted.environment(), len(table) - len(simulated.time)
    env.reset(seed=0, options={"state": simulated.states[0]})
    env._asked = [table.voltage.to_numpy()[at - 1 - i : at - i] for i in range(len(env._asked))]
    for k in range(50):
        state, reward, ended, cut, _ = env.step(table.voltage.to_numpy()[at + k : at + k + 1])
        np.testing.assert_allclose(state, simulated.states[k + 1], atol=1e-6)
        assert (reward, ended, cut) == (0.0, False, False)


def test_a_given_delay_that_does_not_fit_is_said() -> None:
    found = dopt.fit(declared(delay=0.0), run(3), width=0)
    assert any("declare a delay of 0.02 s" in note for note in found.selection.notes)


@pytest.mark.parametrize(
    ("lag", "counts", "said"), [(0.08, 4096, "the logs tell"), (0.005, 60, "the logs do not tell")]
)
def test_the_report_says_whether_delay_and_lag_are_told_apart(
    lag: float, counts: int, said: str
) -> None:
    """A lag of four samples is; a quarter of a sample, seen in steps of 6°, is not."""
    unknown = {"delay": dopt.unknown(0.0, spread=0.03), "lag": dopt.unknown(0.03, factor=3)}
    plant = declared(measured={"angle": dopt.encoder(counts)}, **unknown)
    found = dopt.fit(plant, run(0, lag=lag, counts=counts), width=0)
    [note] = [note for note in found.selection.notes if "apart" in note]
    assert note.startswith(said)
    assert f"note: {note}" in found.report()
    (delay, _), (late, _) = found.constants["delay"], found.constants["lag"]
    assert delay + late == pytest.approx(0.02 + lag, abs=2e-3), "their sum is known in both cases"


@pytest.mark.parametrize(
    ("guess", "late"),
    [
        (dopt.unknown(0.0, spread=0.1), 0.18),  # beyond the first delays that are tried
        (dopt.unknown(0.03, factor=3), 0.22),
        (dopt.unknown(0.001), 0.02),  # earlier ones would be of the other sign
    ],
)
def test_a_delay_is_found_as_far_as_it_was_declared_to_be(guess: Any, late: float) -> None:
    table = run(0)
    shifted = table.voltage.shift(-round((late - 0.02) / 0.02)).ffill()
    found = dopt.fit(declared(delay=guess), table.assign(voltage=shifted), width=0)
    value, error = found.constants["delay"]
    assert abs(value - late) < 5 * error + 1e-4


def test_a_delay_keeps_its_prior_as_other_constants_do() -> None:
    """Its spread was one sample, whatever was declared."""
    for declared_delay in (dopt.unknown(0.05, spread=1e-6), dopt.unknown(0.05, factor=1.00001)):
        found = dopt.fit(declared(delay=declared_delay), run(0, 600), width=0, window=0.6)
        assert found.constants["delay"][0] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(
    ("hold", "better"), [("zero", "linear"), ("linear", "cubic"), ("cubic", "")]
)
def test_what_a_smooth_input_does_between_rows_is_said(hold: str, better: str) -> None:
    """A mass on a spring over a road, of which constants were far off without a word."""
    rng, t = np.random.default_rng(0), np.arange(2400.0) * 0.01
    frequencies, phases = rng.uniform(0.5, 6, 12), rng.uniform(0, 6, 12)

    def road(s: float) -> Any:
        return np.sin(2 * math.pi * frequencies * s + phases).sum() / 5

    def rate(s: float, x: Array) -> list[float]:
        return [x[1], 200 * (road(s) - x[0]) - 3 * x[1]]

    x = solve_ivp(rate, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    plant = dopt.Plant(
        states={"height": "m", "speed": "m/s"},
        inputs={"road": "m"},
        dt=0.01,
        gamma=2.0,
        known={"height": "speed", "speed": "spring * (road - height) - damping * speed"},
        constants={"spring": dopt.unknown(150.0), "damping": dopt.unknown(2.0)},
        learned=["speed"],
        box={"speed": 10.0},
        measured={"height": 1e-3},
    )
    table = {"t": t, "height": x + 1e-3 * rng.normal(size=2400), "road": [*map(road, t)]}
    found = dopt.fit(plant, table, width=0, hold=hold, window=0.5)
    errors = {"spring": 200.0, "damping": 3.0}
    off = max(
        abs(found.constants[name][0] - v) / found.constants[name][1] for name, v in errors.items()
    )
    assert (off > 5) == ("fits better, and moves" in found.report()) == bool(better)
    assert (f"hold='{better}' fits better" in found.report()) == bool(better)


def test_inputs_that_are_held_are_not_doubted_for_the_delay() -> None:
    """Lines come half a sample early, and fit better where the stamps of a logger come late."""
    table, names = run(0), ("gain", "damping", "gravity")
    late = np.random.default_rng(0).uniform(0, 0.002, len(table))
    known = {**declared().constants, **dict(zip(names, TRUE, strict=False))}
    plant = declared(constants=known)
    found = dopt.fit(plant, table.assign(time=table.time + late), width=0, window=0.6)
    assert "fits better" not in found.report()


def test_whole_numbers_need_no_other_machine_code() -> None:
    """A spread of 1 in place of 1.0 compiled all that simulates again, for a minute."""
    kinds = []
    for one, tenth in ((1, 0), (1.0, 0.0)):
        plant = pendulum(delay=dopt.unknown(tenth, spread=one), lag=dopt.unknown(one), dt=one)
        model = Model(plant)
        parts = model.values(model.prior), model.structure
        kinds.append([str(problem._kind(part)) for part in parts])
    assert kinds[0] == kinds[1]


def test_units_of_a_state_do_not_matter() -> None:
    table, results = run(6, 600), []
    for unit in (1.0, 8.0, 1000.0):
        force = f"gain * voltage - damping * rate * {unit} - gravity * sin(angle + offset)"
        known = {"angle": f"rate * {unit}", "rate": f"({force}) / {unit}"}
        plant = declared(known=known, box={"rate": 10.0 / unit})
        results.append(dopt.fit(plant, table, width=4, weights=(10.0,), window=0.6).constants)
    for other, tolerance in zip(results[1:], (0.0, 1e-6), strict=True):
        for name, found in results[0].items():
            assert other[name] == pytest.approx(found, rel=tolerance, abs=0), name


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"width": -1}, "width is -1, but a whole number of at least 0"),
        ({"hold": "quintic"}, "hold is 'quintic', but one of zero, linear, cubic"),
        ({"window": 1e9}, "window is"),
        ({"weights": (0.0,), "width": 4}, "weights is"),
        ({"workers": 0}, "workers is 0"),
        ({"logs": []}, "no log was given"),
        ({"logs": run(0, 6)[:2]}, "longest piece of a block, of 2 that"),
        ({"logs": run(0, 6)[["time", "angle"]]}, "voltage"),
        ({"plant": {}}, r"dopt\.Plant is expected"),
    ],
)
def test_what_cannot_be_fitted_is_said(arguments: dict[str, object], said: str) -> None:
    given = {"plant": declared(), "logs": run(0, 60), "width": 0} | arguments
    with pytest.raises(SpecificationError, match=said):
        dopt.fit(**given)  # type: ignore[arg-type]


def test_states_that_are_measured_at_different_times_are_judged() -> None:
    table = run(0)
    rate = np.gradient(table.angle, table.time)
    odd = np.arange(len(table)) % 2 == 1
    table = table.assign(angle=table.angle.where(~odd), rate=np.where(odd, rate, np.nan))
    both = {"angle": dopt.encoder(4096), "rate": 0.1}
    found = dopt.fit(declared(measured=both), table, width=0, window=0.3)
    rows = [row for row in found.errors() if row["model"] == "model"]
    assert {row["state"] for row in rows} == {"angle", "rate"}
    assert {row["windows"] for row in rows[2:]} == {15}
    assert found.verdict().startswith("Useful up to 1.2 s")
    assert min(found.coverage().values()) > 0.7


def test_a_state_that_hardly_moves_within_the_noise_is_not_judged_there() -> None:
    """A model without a fault was called no better than that nothing changes."""
    table = run(3)
    rng, drift = np.random.default_rng(0), 0.02 * np.cumsum(np.sin(table.angle)) * 0.02
    table["level"] = drift + 0.01 * rng.normal(size=len(table))
    plant = declared(
        states={"angle": "rad", "rate": "rad/s", "level": "m"},
        known={**declared().known, "level": "slow * sin(angle)"},
        constants={**declared().constants, "slow": dopt.unknown(0.01)},
        measured={"angle": dopt.encoder(4096), "level": 0.01},
    )
    assert dopt.fit(plant, table, width=0).verdict().startswith("Useful up to")


def test_errors_grow_on_beyond_the_last_horizon() -> None:
    """Bounds of an angle that nothing pulls back held a quarter of a long run."""
    seconds, noise = np.array([0.0, 0.5, 4.0, 16.0, 64.0]), np.array([0.01, 0.5])
    steps = np.arange(1, 41) * 0.1
    error = np.column_stack([0.02 * np.sqrt(steps), 0.1 * np.ones(40)])
    made = problem.Predicted([steps] * 3, [error] * 3, [np.ones((40, 2))] * 3, np.ones(2))
    found = problem.errors_ahead([made], [1.0, 2.0, 4.0], seconds, noise)
    np.testing.assert_allclose(found[2:, 0], 0.02 * np.sqrt(seconds[2:]))
    np.testing.assert_array_equal(found[:, 1], 0.5)


def test_short_runs_are_judged_as_far_as_they_go() -> None:
    """A block alone has no other ones that bound it; a run of one window is predicted."""
    other = run(1)
    found = dopt.fit(declared(), [run(0), other[:30], other[30:60]], width=0)
    assert np.isnan(found.coverage()["angle"])
    assert "Bounds of 90 % are not judged on held-out angle" in found.report()
    for rows, words in (
        (300, "Useful up to 0.6 s, the longest time judged, by 6 predictions"),
        (60, "Not judged: 2 predictions at most, but 5 are expected"),
        (15, "Not judged: no run is long"),
    ):
        short = dopt.fit(declared(), run(0), width=0, window=0.6, validate=other[:rows])
        assert short.verdict().startswith(words)


def test_a_log_that_is_short_beside_its_motion_is_said(fitted: Fitted) -> None:
    """Windows of a few samples were taken without a word."""
    short = dopt.fit(declared(), run(0, 156), width=0)
    [note] = [one for one in short.selection.notes if one.startswith("the log is short")]
    assert f"windows of {short.selection.window:.2g} s are the longest" in note
    assert "record" in note
    assert "the log is short" not in fitted.report()


def test_stamps_in_another_unit_are_refused() -> None:
    """They were integrated in steps of the plant's dt, for hours."""
    table = run(0, 60)
    for scale in (1e3, 1e-3, 1e9):
        with pytest.raises(SpecificationError, match=r"the plant's dt of 0.02.*units={'time'"):
            dopt.fit(declared(), table.assign(time=scale * table.time), width=0)


def test_what_never_changes_in_the_logs_is_said() -> None:
    data = run(0, 420)
    with pytest.raises(SpecificationError, match=r"nothing that was measured .angle. changes"):
        dopt.fit(declared(), data.assign(angle=1.0), width=0)
    found = dopt.fit(declared(), data.assign(voltage=0.0), width=0, window=0.4)
    assert "voltage never changes in the logs" in found.report()


def test_equations_that_nothing_follows_are_said() -> None:
    """Two counters with zeros far apart: a stiff shaft between them led every state away."""
    t, u = np.arange(400) * 0.02, np.random.default_rng(0).uniform(-2, 2, 400)
    angle = np.cumsum(0.02 * u)
    plant = pendulum(
        states={"angle": "rad", "load": "rad", "rate": "rad/s"},
        known={"angle": "rate", "load": "rate", "rate": "gain * voltage - 1e4 * (angle - load)"},
        constants={"gain": dopt.unknown(1.0)},
        angles=["angle", "load"],
        measured={"angle": 0.01, "load": 0.01},
    )
    data = {"time": t, "voltage": u, "angle": angle, "load": angle + 3e6}
    with pytest.raises(SpecificationError, match=r"no window of .* zeros of the measured states"):
        dopt.fit(plant, data, width=0)


def test_steps_that_are_too_long_are_said(fitted: Fitted) -> None:
    found = dopt.fit(declared(dt=0.12), run(0)[::6], width=0)
    assert "steps of 0.12 s are too long for these equations" in found.report()
    assert "too long" not in fitted.report()


def test_a_plant_without_unknowns_gets_a_network_alone() -> None:
    known = dict(zip(("gain", "damping", "gravity", "offset"), TRUE, strict=True))
    found = dopt.fit(
        declared(constants=known, delay=0.02), run(1, drag=0.4), width=4, weights=(10.0,)
    )
    assert found.constants == {}
    assert found.has_network
    with pytest.raises(SpecificationError, match="something to fit is expected"):
        dopt.fit(declared(constants=known, delay=0.02), run(1), width=0)


def test_a_block_that_judges_nothing_is_fitted_to_all_the_same() -> None:
    """The last run of four is too short to be predicted."""
    tables = [run(seed) for seed in range(3)] + [run(3)[:45]]
    found = dopt.fit(declared(), tables, width=0, window=0.7)
    first_rows = found.chosen.solution.windows.rows[:, 0]
    assert (first_rows >= sum(map(len, tables[:3]))).any()
