"""Fits of simulated runs whose constants are known, and what they give away."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

import dopt
from dopt.errors import SpecificationError
from dopt.fitting.fitted import Fitted
from tests.dopt.fitting.test_simulation import pendulum, stamps, truth

TRUE = (24.0, 1.4, 33.0, 0.1)


def run(
    seed: int,
    n: int = 1200,
    delay: float = 0.02,
    drag: float = 0.0,
    lag: float = 0.0,
    counts: int = 4096,
) -> pd.DataFrame:
    """Return a run whose angle is measured in steps of a turn of so many counts."""
    rng = np.random.default_rng(seed)
    t, u = stamps(rng, n, 0.0), np.repeat(rng.uniform(-2.5, 2.5, n // 6), 6)
    x = (
        truth(t, u, delay, lag, np.array([0.0, 0.0]), TRUE)
        if not drag
        else dragged(t, u, delay, drag)
    )
    quantum = 2 * math.pi / counts
    return pd.DataFrame({"time": t, "angle": np.round(x[:, 0] / quantum) * quantum, "voltage": u})


def dragged(t: np.ndarray, u: np.ndarray, delay: float, drag: float) -> np.ndarray:
    """Simulate with quadratic drag, which the plant does not declare."""
    x, out = np.zeros(2), [np.zeros(2)]
    gain, damping, gravity, offset = TRUE
    for k in range(len(t) - 1):
        for i in range(20):
            h, s = (t[k + 1] - t[k]) / 20, t[k] + (i + 0.5) * (t[k + 1] - t[k]) / 20
            v = u[max(int(np.searchsorted(t + delay, s)) - 1, 0)]

            def rate(x: np.ndarray, v: float = v) -> np.ndarray:
                force = gain * v - damping * x[1] - gravity * math.sin(x[0] + offset)
                return np.array([x[1], force - drag * x[1] * abs(x[1])])

            x = x + h * rate(x + 0.5 * h * rate(x))
        out.append(x)
    return np.array(out)


def declared(**changed: object) -> dopt.Plant:
    given: dict[str, object] = {
        "measured": {"angle": dopt.encoder(4096)},
        "delay": dopt.unknown(0.0, spread=0.02),
    }
    return pendulum(**(given | changed))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """Return a fit to a run with drag, whose network the validation wants."""
    return dopt.fit(declared(), run(0, drag=0.4), width=6, weights=(10.0, 3.0))


def loader() -> ModuleType:
    path = Path(__file__).parents[3] / "docs/example/load_model.py"
    spec = importlib.util.spec_from_file_location("load_model", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def test_a_network_is_refused_where_the_constants_tell_all() -> None:
    found = dopt.fit(declared(), run(5), width=6, weights=(10.0,))
    assert not found.has_network
    assert "no network" in found.report()


def test_a_network_is_kept_where_something_is_not_declared(fitted: Fitted) -> None:
    assert fitted.has_network
    rows = [row for row in fitted.errors() if row["horizon"] == max(fitted.horizons[:3])]
    by_model = {row["model"]: row["rms"] for row in rows}
    assert by_model["model"] < 0.7 * by_model["physics alone"] < by_model["linear"]
    assert fitted.verdict().startswith("Useful up to")


def test_bounds_hold_what_they_say_on_another_run(fitted: Fitted) -> None:
    other = dopt.Log.for_plant(run(9, drag=0.4), fitted.plant)
    simulated = fitted.simulate(other, level=0.9)[0]
    measured = other.pieces[0].measured[-len(simulated.time) :, 0]
    later = simulated.time > simulated.time[0] + fitted.selection.window
    inside = (measured >= simulated.lower[:, 0]) & (measured <= simulated.upper[:, 0])
    assert 0.75 <= inside[later].mean() <= 1.0
    assert 0.8 <= fitted.coverage(0.9)["angle"] <= 0.98


@pytest.mark.parametrize("columns", ["zero", "linear"])
def test_a_saved_model_needs_numpy_alone(fitted: Fitted, tmp_path: Path, columns: str) -> None:
    fitted.save(tmp_path / columns)
    derivative, step = loader().load(tmp_path / f"{columns}.npz")
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(50, 2)) * [2.0, 8.0], rng.normal(size=(50, 1))
    expected = fitted.predict(x, u)
    np.testing.assert_allclose(
        [derivative(*at) for at in zip(x, u, strict=True)], expected, rtol=1e-9
    )
    reached = step(x[0], u[0], 1e-4)
    np.testing.assert_allclose((reached - x[0]) / 1e-4, expected[0], rtol=1e-2)


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


def test_the_median_of_the_report_is_of_the_model(fitted: Fitted) -> None:
    [row, *_] = [row for row in fitted.errors() if row["model"] == "model"]
    assert f"median of the model {row['median']:.3g}\n" in fitted.report()


def test_a_url_is_no_file(fitted: Fitted) -> None:
    with pytest.raises(SpecificationError, match=r"give the URL to store\(\)"):
        fitted.save("sqlite:///results.db")


def test_units_of_a_state_do_not_matter() -> None:
    table, results = run(6), []
    for unit in (1.0, 8.0, 1000.0):
        plant = declared(
            known={
                "angle": f"rate * {unit}",
                "rate": f"(gain * voltage - damping * rate * {unit} "
                f"- gravity * sin(angle + offset)) / {unit}",
            },
            box={"rate": 10.0 / unit},
        )
        results.append(dopt.fit(plant, table, width=4, weights=(10.0,), window=0.6))
    first = results[0]
    for other, tolerance in zip(results[1:], (0.0, 1e-6), strict=True):
        for name, (value, error) in first.constants.items():
            assert other.constants[name] == pytest.approx((value, error), rel=tolerance, abs=0), (
                name
            )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"width": -1}, "width is -1, but a whole number of at least 0"),
        ({"hold": "cubic"}, "hold is 'cubic'"),
        ({"window": 1e9}, "window is"),
        ({"weights": (0.0,), "width": 4}, "weights is"),
        ({"workers": 0}, "workers is 0"),
        ({"logs": []}, "no log was given"),
        (
            {"logs": pd.DataFrame({"time": [0.0, 0.02], "angle": [0.0, 0.1], "voltage": 1.0})},
            "longest piece",
        ),
        ({"logs": pd.DataFrame({"time": [0.0, 0.02], "angle": [0.0, 0.1]})}, "voltage"),
    ],
)
def test_what_cannot_be_fitted_is_said(arguments: dict[str, object], said: str) -> None:
    given = {"logs": run(0, 60), "width": 0} | arguments
    with pytest.raises(SpecificationError, match=said):
        dopt.fit(declared(), **given)  # type: ignore[arg-type]
    with pytest.raises(SpecificationError, match=r"dopt\.Plant is expected"):
        dopt.fit({}, **given)  # type: ignore[arg-type]


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
