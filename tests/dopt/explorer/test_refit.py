"""The learner that fits simulations beside an exploration."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import SYSTEMS, Explorer, Plant, TrialSpec, encoder, unknown
from dopt.errors import IncompatibleError, SpecificationError
from dopt.explorer.refit import FitBeside, Found
from dopt.explorer.state import InFlight
from dopt.fitting.model import Layout, Model
from dopt.kernel import run
from dopt.spec.scaled import learned_accelerations, scaled
from dopt.systems.plant import ExploredPlant
from tests.dopt.explorer.plants import HOVERCRAFT, MOTOR, Rig, motor_acceleration
from tests.waiting import PATIENCE_SECONDS, until

DT = MOTOR.dt
SMALL = {"name": "mlp", "depth": 1, "width": 6}
PLANT = dataclasses.replace(
    MOTOR, constants={"gain": unknown(8.0)}, delay=unknown(0.0, spread=0.02), lag=unknown(0.02)
)


def late_rig() -> Rig:
    """Return the motor in continuous time behind a delay of 1.5 samples and a lag."""
    return Rig(1.5, 0.03, substeps=20)


def explorer(plant: Plant = PLANT, **more: Any) -> Explorer:
    given = {"policy": "random", "model": SMALL, "learner": "simulation_error", "steps": 400}
    return Explorer(plant, **{**given, **more})


def drive(one: Explorer, rig: Rig, steps: int) -> None:
    for _ in range(steps):
        one.tell(rig.step(one.ask(rig.x, rig.time)), time=rig.time)


def test_the_plant_is_found_beside_the_rig() -> None:
    rig = late_rig()
    with explorer() as one:
        drive(one, rig, 300)
        assert one.counts["refits"] >= 3
        assert one.constants["gain"] == pytest.approx(5.0, rel=0.05)
        assert one.constants["delay"] + one.constants["lag"] == pytest.approx(0.06, abs=0.006)
        at = one.states[:300]
        missed = one.predict(at)[:, 0] - np.array([motor_acceleration(x) for x in at])
        assert np.median(np.abs(missed)) < 0.5


def test_a_network_is_fitted_beside_while_samples_are_filtered(tmp_path: Path) -> None:
    """Along the run it is better than by the filter alone."""
    missed = {}
    for every in (0, 400):
        learner = {"name": "gauss_newton", "refit_every": every}
        given: dict[str, Any] = {"learner": learner, "model": "mlp", "seed": 2, "steps": 200}
        with explorer(MOTOR, journal=tmp_path / f"{every}.jsonl", **given) as one:
            rig = Rig(substeps=20)
            for _ in range(200):
                drive(one, rig, 1)
                until(lambda fits=one._fits: not fits or fits.is_ready or not fits.is_running)
            assert (one.counts["refits"] >= 3) == (every == 0)
            wrong = one.predict(one.states)[:, 0] - [motor_acceleration(x) for x in one.states]
            missed[every] = np.sqrt(np.mean(wrong**2))
            before = one.counts["refits"], one.parameters.copy()
        with explorer(MOTOR, journal=tmp_path / f"{every}.jsonl", **given) as again:
            assert again.counts["refits"] == before[0]
            np.testing.assert_array_equal(again.parameters, before[1])
    assert missed[0] < 0.7 * missed[400]


def test_a_supply_that_is_not_declared_is_found_and_replayed_bit_for_bit(tmp_path: Path) -> None:
    plant = dataclasses.replace(PLANT, constants={"gain": 5.0})
    given: dict[str, Any] = {"policy": "d_optimal", "journal": tmp_path / "run.jsonl"}
    rig = Rig(1.5, 0.03, supply=4.0, substeps=20)
    with explorer(plant, **given) as one:
        drive(one, rig, 260)
        assert one.counts["supply"] >= 1
        asked = one.ask(rig.x, rig.time)
        assert abs(asked[0]) == pytest.approx(4.0, rel=0.05)
        before, counts = (one.parameters.copy(), one.inputs), (dict(one.counts), one.constants)
    with explorer(plant, **given) as again:
        assert (again.counts, again.constants) == counts
        for left, right in zip(before, (again.parameters, again.inputs), strict=True):
            np.testing.assert_array_equal(left, right)
        np.testing.assert_array_equal(again.ask(rig.x, rig.time), asked)
        drive(again, rig, 60)
        until(lambda: again._fits is None or again._fits.is_ready)
        drive(again, rig, 1)
        assert again.counts["refits"] > counts[0]["refits"] >= 1


KILLED = """
import sys
from tests.dopt.explorer.test_refit import drive, explorer, late_rig
with explorer(journal=sys.argv[1], fsync=False) as one:
    rig = late_rig()
    while True:
        drive(one, rig, 1)
        print(one.n_steps, one.counts["refits"], one.parameters.tobytes().hex(), flush=True)
"""


@pytest.mark.parametrize("refits", [0, 2])
def test_what_a_killed_process_had_learned_is_there_again(tmp_path: Path, refits: int) -> None:
    path = tmp_path / "run.jsonl"
    code = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(code, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for line in process.stdout:
            steps, count, parameters = line.split()
            if int(count) >= refits and int(steps) >= 160:  # a fit is running
                os.kill(process.pid, signal.SIGKILL)
                break
        *rest, _ = process.stdout.read().split("\n")  # what follows the last newline is torn
    steps, count, parameters = rest[-1].split() if rest else (steps, count, parameters)
    with explorer(journal=path) as again:
        told = (again.n_steps, again.counts["refits"], again.parameters.tobytes().hex())
        assert told[0] >= int(steps)
        assert told[:2] != (int(steps), int(count)) or told[2] == parameters


def test_a_network_in_scaled_numbers_is_the_network_of_the_fit() -> None:
    rng = np.random.default_rng(3)
    for plant in (MOTOR, HOVERCRAFT):
        with Explorer(plant, policy="random", model=SMALL, steps=10) as one:
            spec = one.spec
        found = scaled(spec.system)
        p, r = len(found.system.features), found.system.n_learned
        layout = Layout(rng.normal(size=p), rng.uniform(0.5, 9.0, p), rng.uniform(0.1, 50.0, r))
        model = Model(plant, width=6, layout=layout)
        weights = rng.normal(size=model.n_weights)
        ordered = np.concatenate([part.ravel() for part in model.matrices(weights)])
        numbers = np.zeros(len(plant.constants)), 0.0, 0.0, ordered, *layout
        theta = Found(*numbers).parameters(found, 6, np.zeros(model.n_weights))
        states = rng.normal(size=(50, len(plant.states))) * 3.0
        np.testing.assert_allclose(
            learned_accelerations(spec, theta, states),
            model.network(weights, states),
            rtol=1e-9,
            atol=1e-9,
        )


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.05), (2.3 * DT, 0.0), (3 * DT, 0.02)])
def test_inputs_in_flight_are_as_if_the_delay_had_been_known(delay: float, lag: float) -> None:
    system = PLANT.system(10)
    later = dataclasses.replace(system, fitted=(5.0, delay, lag))
    first, other = InFlight(system), InFlight(later)
    rng = np.random.default_rng(0)
    for flight in (first, other):
        flight.hold(np.array([0.5]), None)
    for u in rng.normal(size=(40, 1)):
        first.depart(u)
        other.depart(u)
    second = first.retimed(later)
    for u in rng.normal(size=(5, 1)):
        np.testing.assert_allclose(second.depart(u), other.depart(u), atol=1e-12)


def test_a_gap_a_reset_and_a_jump_begin_new_pieces() -> None:
    rig = late_rig()
    with explorer() as one:
        drive(one, rig, 10)
        rig.time += 1.0  # a gap
        drive(one, rig, 10)
        one.reset()
        drive(one, rig, 10)
        rig.x, rig.time = rig.x + 0.5, rig.time + 0.3 * DT  # a jump
        drive(one, rig, 10)
        one.ask(rig.x, rig.time + 0.1 * DT)  # the same state, asked later
        one.tell(rig.x, time=rig.time + DT)
        log = one.log()
        assert [len(piece.time) for piece in log.pieces] == [11, 11, 11, 12]
        assert log.n_rows == one.n_steps + 4
        steps = np.diff(log.pieces[-1].time) / DT
        assert steps == pytest.approx([*[1.0] * 9, 1.1, 0.9])


def test_a_state_that_is_not_measured_is_left_to_the_fit() -> None:
    plant = dataclasses.replace(PLANT, measured={"angle": encoder(4096)})
    rig = late_rig()
    with explorer(plant) as one:
        for _ in range(250):
            u = one.ask(rig.x[:1], rig.time)
            rig.step(u)
            one.tell(rig.x[:1], time=rig.time)
        assert one.counts["refits"] >= 1
        assert one.constants["gain"] == pytest.approx(5.0, rel=0.2)


@pytest.mark.parametrize("learner", ["adam_window", "gauss_newton", "simulation_error"])
def test_no_step_waits_for_its_code(monkeypatch: pytest.MonkeyPatch, learner: str) -> None:
    """What steps, plans for a late plant and updates in numpy call is loaded before the first."""
    plant = dataclasses.replace(MOTOR, delay=1.5 * DT)
    with Explorer(plant, policy="random", learner=learner, steps=20) as one:
        monkeypatch.setattr(run, "compiled_step", None)
        drive(one, late_rig(), 20)
        assert one.n_steps == 20


def test_with_a_deadline_no_fit_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    may_end = threading.Event()
    monkeypatch.setattr(FitBeside, "_ask", lambda *_: may_end.wait(PATIENCE_SECONDS) and "nothing")
    learner = {"name": "simulation_error", "first_rows": 20}
    with explorer(deadline=0.5, learner=learner) as one:
        drive(one, late_rig(), 60)
        assert one._fits is not None
        states = one._fits.is_running, one._fits.is_ready, one.counts["refits"]
        may_end.set()
        assert states == (True, False, 0)


def test_a_fit_that_fails_is_said_and_the_next_one_begins(caplog: pytest.LogCaptureFixture) -> None:
    """And the process that fits ends with the exploration."""
    with caplog.at_level(logging.WARNING, logger="dopt"), explorer() as one:
        rig, fits = late_rig(), one._fits
        assert fits is not None
        fits._thread.submit(int).result()  # until the first request is answered
        process = fits._process
        assert process is not None
        drive(one, rig, 150)
        process.kill()
        drive(one, rig, 90)
        assert one.counts["refits"] >= 1
    assert "its process has ended" in caplog.text
    for ended in (process, fits._process):
        assert ended is None or ended.poll() is not None


def test_what_it_cannot_fit_is_refused() -> None:
    with pytest.raises(IncompatibleError, match=r"goes with a dopt.Plant .*, but env 'pendulum'"):
        TrialSpec.from_names("pendulum", "d_optimal", learner="simulation_error", model=SMALL)
    given: tuple[tuple[dict[str, Any], str], ...] = (
        ({"model": "mlp"}, r"goes with model.depth 1, but model.depth 2"),
        ({"model": {"name": "affine", "depth": 1}}, "but model 'affine' was given"),
        (
            {"model": {"name": "grey_box", "unknown": ["gain"]}, "learner": "ekf"},
            r"learner 'simulation_error' estimates the const",
        ),
        ({"path": "reference"}, "kernel alone"),
        ({"learner": {"name": "simulation_error", "growth": -1.0}}, "growth"),
    )
    for more, said in given:
        with pytest.raises(SpecificationError, match=said):
            explorer(**more)


def test_an_explorer_of_a_plant_has_its_guesses_as_constants() -> None:
    with explorer() as one:
        assert one.constants == {"gain": 8.0, "delay": 0.0, "lag": 0.02}
        assert isinstance(one.spec.system, ExploredPlant)
        assert one.spec.system.integrator == "rk4"
        with pytest.raises(SpecificationError, match="nothing was learned yet"):
            one.log()
    with (
        Explorer(SYSTEMS["pendulum"](), policy="random") as one,
        pytest.raises(SpecificationError, match="Plant is expected for a log"),
    ):
        one.log()
