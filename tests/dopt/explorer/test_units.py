"""The units of a plant do not matter: recorded runs in several units, for every learner."""

from __future__ import annotations

import functools
import gzip
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dopt import LEARNERS, Explorer, Plant
from dopt.spec.scaled import scaled
from dopt.systems.black_box import differentiated
from dopt.systems.properties import STEPS_ACROSS
from dopt.types import Array
from tests.dopt.explorer.plants import HOVERCRAFT, steered

RECORDED = Path(os.environ.get("DOPT_DATA", "")) / "disk_train.csv.gz"
DT = 0.025


class Units(NamedTuple):
    """Factors of the numbers of rates and inputs: 1000 for a rate in mrad/s."""

    rate: float = 1.0
    input: float = 1.0


@functools.cache
def disk(units: Units, measured: bool) -> Plant:
    """Return the unbalanced disk, with the constants of its published simulator."""
    return Plant(
        states={"angle": "rad", "rate": "rad/s"},
        inputs={"voltage": "V"},
        dt=DT,
        gamma=3.0 * units.input,
        known={"angle": "rate / factor", "rate": "gain * voltage"},
        constants={"gain": 28.136 * units.rate / units.input, "factor": units.rate},
        learned=["rate"],
        angles=["angle"],
        box={"rate": 20.0 * units.rate},
        measured={"angle": 1e-3} if measured else {},
    )


class Run(NamedTuple):
    """States, (T + 1, 2), and inputs, (T, 1), in rad, rad/s and V."""

    states: Array
    inputs: Array


@functools.cache
def simulated() -> Run:
    """Return a run of a disk with dry friction, whose angles are rounded as by an encoder."""
    rng = np.random.default_rng(7)
    inputs = np.repeat(rng.uniform(-3, 3, 200), 4)
    angles, angle, rate, substeps = [0.0], 0.0, 0.0, 50
    for u in inputs:
        for _ in range(substeps):
            friction = 1.3 * rate + 2.0 * np.tanh(rate)
            rate += DT / substeps * (28.136 * u - 128.6 * np.sin(angle) - friction)
            angle += DT / substeps * rate
        angles.append(round(angle / 0.00314) * 0.00314)
    return measured(np.array(angles), inputs)


def measured(angles: Array, inputs: Array) -> Run:
    """Return a run of which the angles, (T + 1,), were measured, with their differences."""
    return Run(np.column_stack([angles, np.gradient(angles, DT)]), inputs[:, None])


@functools.cache
def recorded() -> Run:
    """Return a part of the recorded run, whose inputs come one sample late."""
    with gzip.open(RECORDED, "rt") as lines:
        u, angles = np.loadtxt(lines, delimiter=",", skiprows=1, max_rows=2802).T
    return measured(angles[2001:2802], u[2000:2800])


WIDE = {
    "bounds": {"angle": [-40, 40], "rate": [-60, 60], "voltage": [-3, 2]},
    "rates": {"voltage": 90},
}

RLS, MEASURED = "recursive_least_squares", True
REFITTED = {"name": "joint_ekf", "refit_every": 40, "noise": "fitted"}
RIDGE, SMALL = {"name": "d_optimal", "regularization": 3.0}, {"name": "mlp", "depth": 1, "width": 8}
PROCESS = "gaussian_process"

CASES: dict[str, tuple[Any, ...]] = {
    "adam": (not MEASURED, "random", "mlp", "adam"),
    "adam_window": (not MEASURED, "d_optimal", "mlp", "adam_window"),
    "adam_window, affine": (not MEASURED, "d_optimal", "affine", "adam_window"),
    "adam_window, limits": (not MEASURED, "d_optimal", "mlp", "adam_window", WIDE),
    "adam_window, filtered": (MEASURED, "random", "mlp", "adam_window"),
    "adam_replay": (not MEASURED, "uniform", "mlp", "adam_replay"),
    "ekf": (not MEASURED, "d_optimal", "mlp", "ekf"),
    "gauss_newton": (not MEASURED, "d_optimal", "mlp", "gauss_newton"),
    "gauss_newton, black box": (not MEASURED, "random", "black_box", "gauss_newton"),
    "gauss_newton, ensemble": (not MEASURED, "d_optimal", "ensemble", "gauss_newton"),
    "recursive_least_squares": (not MEASURED, "d_optimal", "rff", RLS),
    "recursive_least_squares, linear": (not MEASURED, "random", "linear_state", RLS),
    "joint_ekf": (MEASURED, RIDGE, "mlp", "joint_ekf"),
    "joint_ekf, random": (MEASURED, "random", "mlp", REFITTED),
    "conditioning": (not MEASURED, PROCESS, PROCESS, "conditioning"),
    "simulation_error": (not MEASURED, "random", SMALL, "simulation_error"),
}
"""True if the angle alone is measured; policy, model, learner, and limits."""


def test_every_learner_is_among_them() -> None:
    def name(learner: Any) -> str:
        return str(learner["name"] if isinstance(learner, dict) else learner)

    assert {name(case[3]) for case in CASES.values()} == set(LEARNERS)


def in_units(limits: dict[str, Any], units: Units) -> dict[str, Any]:
    factors = {"angle": 1.0, "rate": units.rate, "voltage": units.input}
    bounds = {k: [end * factors[k] for end in ends] for k, ends in limits["bounds"].items()}
    return {"bounds": bounds, "rates": {k: v * factors[k] for k, v in limits["rates"].items()}}


class Learned(NamedTuple):
    """What an explorer has learned, with numbers in rad/s and V."""

    parameters: Array
    errors: Array
    states: Array
    answer: Array
    predicted: Array
    free_run_error: float
    refits: int


def learned(case: str, units: Units, steps: int) -> Learned:
    """Let an explorer learn from the first steps of a run in other units."""
    run = recorded() if RECORDED.is_file() else simulated()
    is_measured, policy, model, learner, *limits = CASES[case]
    given: dict[str, Any] = {"policy": policy, "model": model, "learner": learner}
    if limits:
        given["limits"] = in_units(limits[0], units)
    states, inputs = run.states * [1.0, units.rate], run.inputs * units.input
    told = states[:, :1] if is_measured else states
    with Explorer(disk(units, is_measured), steps=steps + 1, **given) as one:
        one.tell(told[0])
        for x, u in zip(told[1 : steps + 1], inputs, strict=False):
            assert one.tell(x, applied=u)
        at = one.predict(states[:-1:40], inputs[::40])
        return Learned(
            one.parameters.copy(),
            one.errors / (1.0 if is_measured else units.rate),
            one.states / [1.0, units.rate],
            one.ask(told[steps]) / units.input,
            at / units.rate,
            one.free_run_error(told[-301:], inputs[-300:]),
            one.counts["refits"],
        )


@pytest.mark.parametrize("case", CASES)
def test_powers_of_two_change_no_bit(case: str) -> None:
    """Other factors change the rounding alone. A fit to simulations is made in 200 steps."""
    fitted = case == "simulation_error"
    steps = 200 if fitted else 100
    expected = learned(case, Units(), steps)
    assert (expected.refits > 0) == fitted
    for units in (Units(1024.0, 0.125), Units(0.125, 1024.0))[fitted:]:
        for found, known in zip(learned(case, units, steps), expected, strict=True):
            np.testing.assert_array_equal(found, known, err_msg=str(units))


@pytest.mark.parametrize("case", CASES)
def test_other_units_change_hardly_anything(case: str) -> None:
    found, expected = (learned(case, units, 200) for units in (Units(0.1, 1000.0), Units()))
    costs = (np.cumsum(one.errors[:100] ** 2) for one in (found, expected))
    np.testing.assert_allclose(*costs, rtol=1e-6)
    assert found.free_run_error == pytest.approx(expected.free_run_error, rel=0.05)


def sized(**changed: Any) -> Plant:
    """Return a plant whose box says nothing of most states."""
    given: dict[str, Any] = {
        "states": {"place": "m", "speed": "m/s", "level": "V"},
        "inputs": {"force": "N"},
        "dt": 0.1,
        "gamma": 2.0,
        "known": {"place": "speed", "speed": "force / 4"},
        "learned": ["level"],
        "box": {"level": 5.0},
    }
    return Plant(**(given | changed))


def test_a_state_without_a_box_is_divided_by_how_far_rates_lead_and_its_limit_goes_by_it() -> None:
    seconds = STEPS_ACROSS * 0.1
    place, speed, level = sized().scales
    assert speed == pytest.approx(2.0 / 4.0 * seconds)
    assert 0.9 * speed * seconds < place <= speed * seconds
    assert level == pytest.approx(5.0 / seconds)
    known = {"place": "speed / 1000", "speed": "0", "level": "force"}
    through = sized(known=known, learned=["speed"], box={"place": 3.0})  # what leads through it
    assert through.scales[1] * seconds == pytest.approx(1000.0 * 3.0 / seconds)
    assert sized().system(5, scaled=True).state_limits[2] == 5000.0
    assert (sized(limit=7.0).system(5, scaled=True).state_limits == 7.0).all()
    assert (sized().system(5).state_limits == 1e4).all()


def test_a_rate_in_other_units_is_found_by_differences() -> None:
    system = disk(Units(1000.0), True).system(5)
    positions, factors = differentiated(system)
    assert positions == [0, 0]
    assert factors == pytest.approx([1.0, 1e-3])


def test_errors_of_several_units_are_in_these() -> None:
    """The first error of the hovercraft is that of its accelerations in m/s² and rad/s²."""
    with Explorer(HOVERCRAFT, policy="random", steps=5) as one:
        x = np.array([0.5, 0.3, -0.4])
        u = one.ask(x)
        expected = (steered(x, u) - x)[[0, 2]] / HOVERCRAFT.dt - [u[0], 2.0 * u[1]]
        expected -= one.predict(x)[0]
        one.tell(steered(x, u))
        assert one.errors[0] == pytest.approx(np.linalg.norm(expected), rel=1e-9)
        assert np.array_equal(one.states[1], steered(x, u))


def test_parts_of_ones_own_are_given_the_units() -> None:
    coin: dict[str, object] = {"_target_": "tests.dopt.custom_plugins.Coin"}
    with Explorer(HOVERCRAFT, policy=coin, steps=5) as one:
        assert not getattr(one.spec.system, "scaled", False)
        assert not scaled(one.spec.system).is_scaled
