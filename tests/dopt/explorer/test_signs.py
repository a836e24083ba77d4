"""Signs that an exploration fails: what is counted, said once, replayed, stored and shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

import dopt
import dopt.explorer.explorer as module
import dopt.explorer.signs as signs_module
from analysis.serve.app import create_app
from dopt import Explorer, encoder
from dopt.control import planning
from dopt.errors import counted
from dopt.explorer.signs import SIGNS
from dopt.models import gaussian_process
from dopt.spec.scaled import in_scaled_numbers
from dopt.types import Array
from orchestrate.store import Reader
from tests.dopt.explorer.plants import MOTOR, Rig, content, explorer, following, without_checksums

STEPS = 800


def drive(one: Explorer, steps: int, delay: int = 0, noise: float = 1e-3) -> None:
    """Let the motor follow the answers, so many steps late, with noise."""
    rng, x = np.random.default_rng(0), np.array([0.1, 0.0])
    late = [np.zeros(1)] * delay
    for _ in range(steps):
        late.append(one.ask(x))
        x = following(x, late.pop(0)) + noise * rng.normal(0.0, [0.1, 1.0])
        one.tell(x)


def follow(one: Explorer, rig: Rig, counts: int) -> None:
    """Let a rig whose angle is measured by an encoder follow the answers, to the last step."""
    quantum = encoder(counts).quantum
    y = quantum * np.round(rig.x[:1] / quantum)
    while one.n_steps < one.spec.system.horizon:
        y = quantum * np.round(rig.step(one.ask(y))[:1] / quantum)
        one.tell(y)


def signs(one: Explorer) -> dict[str, int]:
    return {sign: one.counts[sign] for sign in SIGNS if one.counts[sign]}


def said(log: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in log.records if record.name == "dopt.explorer"]


def test_a_motor_as_declared_shows_no_sign(caplog: pytest.LogCaptureFixture) -> None:
    with explorer(policy="d_optimal", steps=STEPS) as one:
        drive(one, STEPS)
        assert signs(one) == {}
    assert said(caplog) == []


@pytest.mark.parametrize("delay", [1, 3])
def test_an_undeclared_delay_is_said_in_samples(
    caplog: pytest.LogCaptureFixture, delay: int
) -> None:
    with explorer(steps=STEPS) as one:
        drive(one, STEPS, delay)
        assert one.counts["late"] == 2  # at steps 500 and 800
    [text] = [text for text in said(caplog) if "earlier steps" in text]
    assert f"{counted(delay, 'sample')} before" in text
    with Explorer(
        dataclasses.replace(MOTOR, delay=delay * MOTOR.dt), policy="random", steps=STEPS
    ) as one:
        drive(one, STEPS, delay)
        assert one.counts["late"] == one.counts["early"] == 0


@pytest.mark.parametrize("policy", ["random", "d_optimal"])
@pytest.mark.parametrize(("declared", "delay"), [(1, 0), (4, 1), (4, 3), (13, 11), (20, 2)])
def test_a_delay_that_is_declared_too_long_is_said(
    caplog: pytest.LogCaptureFixture, declared: int, delay: int, policy: str
) -> None:
    with Explorer(
        dataclasses.replace(MOTOR, delay=declared * MOTOR.dt), policy=policy, steps=STEPS
    ) as one:
        drive(one, STEPS, delay)
        assert (one.counts["early"], one.counts["late"]) == (2, 0)
    [text] = [text for text in said(caplog) if "not to act yet" in text]
    assert f"{counted(delay, 'sample')} before" in text


def test_a_delay_that_a_fit_shortens_is_tested_on() -> None:
    """The inputs on their way are fewer from one step to the next."""
    plant = dataclasses.replace(MOTOR, delay=dopt.unknown(4 * MOTOR.dt, spread=0.1))
    with Explorer(plant, policy="random", learner="simulation_error", steps=STEPS) as one:
        drive(one, STEPS, 1)
        assert one.constants["delay"] < 2 * MOTOR.dt
        assert one.counts["early"] == 0


def test_a_wrong_delay_is_seen_in_angles_alone() -> None:
    """Estimates of the rates depend on earlier inputs, also where the delay is right."""
    learner = {"name": "joint_ekf", "refit_every": 100_000}
    plant = dataclasses.replace(MOTOR, measured={"angle": encoder(2048)})
    ways = ("euler", 0, 0), ("euler", 1, 1), ("rk4", 2, 0), ("rk4", 3, 3), ("euler", 1, -2)
    for integrator, delay, late in (*ways, ("rk4", 0, -1)):
        declared = (delay - late) * MOTOR.dt
        plant = dataclasses.replace(plant, integrator=integrator, delay=declared)
        with Explorer(plant, policy="random", learner=learner, steps=STEPS) as one:
            follow(one, Rig(delay, substeps=4), 2048)
            assert one.counts["late"] == (2 if late > 0 else 0)
            assert one.counts["early"] == (2 if late < 0 else 0)


@pytest.mark.parametrize("horizon", [STEPS, 2 * STEPS])
def test_a_step_does_a_small_part_of_a_test(monkeypatch: pytest.MonkeyPatch, horizon: int) -> None:
    """A plant does not wait for it, unless it is the last step."""
    predicted: list[int] = []

    def predict(system: Any, accelerations: Any, states: Array, inputs: Array) -> Array:
        predicted.append(inputs.shape[0] * inputs.shape[1])
        return planning.predict(system, accelerations, states, inputs)

    monkeypatch.setattr(signs_module, "predict", predict)
    each, x = [], np.array([0.1, 0.0])
    with explorer(steps=horizon) as one:
        for _ in range(STEPS):
            predicted.clear()
            x = following(x, one.ask(x))
            one.tell(x)
            each.append(sum(predicted))
    assert 0 < max(each[:-1]) <= 2 * signs_module.RUNS
    assert (each[-1] > max(each[:-1])) == (horizon == STEPS)


def test_a_test_that_is_not_over_is_finished_at_the_end(caplog: pytest.LogCaptureFixture) -> None:
    with explorer(steps=2 * STEPS) as one:
        drive(one, 520, 2)
        assert one.counts["late"] == 0
    assert one.counts["late"] == 1
    assert any("2 samples before" in text for text in said(caplog))


def test_steps_that_all_begin_elsewhere_are_no_part_of_it() -> None:
    with explorer(steps=STEPS) as one:
        for _ in range(STEPS):
            drive(one, 1)
        assert one.counts["late"] == 0
        assert one.counts["jumps"] == STEPS - 1


def test_gaps_are_no_part_of_the_test_for_a_delay() -> None:
    with explorer(steps=STEPS) as one:
        x, late = np.array([0.1, 0.0]), [np.zeros(1)] * 2
        for step in range(STEPS):
            if step % 40 == 0:  # moved by hand, while the inputs in flight are forgotten
                one.reset()
                x, late = np.array([0.01 * (step % 7), 1.0]), [np.zeros(1)] * 2
            late.append(one.ask(x))
            x = following(x, late.pop(0))
            one.tell(x)
        assert one.counts["late"] > 0


def test_inputs_other_than_asked_are_said_once(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    def go(one: Explorer, steps: int) -> None:
        for step in range(steps):
            u = one.ask(x := one.states[-1] if one.n_steps else np.array([0.1, 0.0]))
            rounded = u * (1.0 + 1e-15)
            applied = 0.5 * u if step % 2 else rounded
            one.tell(following(x, applied), applied=applied)

    with explorer(journal=tmp_path / "run.jsonl") as one:
        go(one, 60)
        counts = one.counts
        assert signs(one) == {"altered": 30}
    assert sum("another input" in text for text in said(caplog)) == 1
    caplog.clear()
    with explorer(journal=tmp_path / "run.jsonl") as again:
        assert again.counts == counts
        assert sum("another input" in text for text in said(caplog)) == 1
        go(again, 60)
    assert sum("another input" in text for text in said(caplog)) == 1


def test_inputs_that_nobody_asked_for_are_not_altered(tmp_path: Path) -> None:
    policy = {"name": "icem", "plans": 4, "elites": 2}  # which remembers its plans
    options: Mapping[str, Any] = {"policy": policy, "journal": tmp_path / "run.jsonl"}
    for _ in range(2):
        with explorer(**options) as one:
            x = one.states[-1] if one.n_steps else np.array([0.1, 0.0])
            one.ask(x)
            one.tell(following(x, np.ones(1)), applied=[1.0])
            for _ in range(30):
                x = one.states[-1]
                one.tell(following(x, np.ones(1)), applied=[1.0])
            assert one.counts["altered"] <= 2


def test_a_model_that_is_worse_than_the_known_part_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Of a plant that is as it is known, the noise is learned."""
    for pull in (0.0, 8.0):
        with explorer(steps=STEPS) as one:
            rng, x = np.random.default_rng(0), np.array([0.1, 0.0])
            for _ in range(STEPS):
                u = one.ask(x)
                x = x + MOTOR.dt * np.array([x[1], 5.0 * u[0] - pull * np.sin(x[0])])
                x += 0.03 * rng.normal(0.0, [0.1, 1.0])
                one.tell(x)
            assert one.counts["worse"] == (pull == 0.0)
    assert ["times the error of the known part alone" in text for text in said(caplog)] == [True]


def test_a_model_of_filtered_states_is_judged_under_filtered_inputs() -> None:
    """From true states the models have 5.9 and 0.3 times the error of the known part."""
    known = {"angle": "rate", "rate": "gain * voltage - 8 * sin(angle) - 0.5 * rate"}
    plant = dataclasses.replace(MOTOR, known=known, velocity_cutoff=5.0)
    for counts, learner, seed, worse in ((250, "gauss_newton", 0, 1), (500, "adam_window", 1, 0)):
        plant = dataclasses.replace(plant, measured={"angle": encoder(counts)})
        with Explorer(plant, learner=learner, steps=500, seed=seed) as one:
            follow(one, Rig(substeps=4), counts)
            assert one.counts["worse"] == worse


def test_states_in_a_small_part_of_the_box_are_said(caplog: pytest.LogCaptureFixture) -> None:
    with explorer(steps=STEPS) as one:
        x = np.array([0.1, 0.0])
        for step in range(STEPS):
            one.ask(x)
            one.tell(x := np.array([0.02 * np.sin(step / 9.0), 0.0]), applied=[0.0])
        assert one.counts["narrow"] == 2
    assert sum("% of the box along angle [rad]" in text for text in said(caplog)) == 1


def test_states_beyond_the_limits_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    limits = {"bounds": {"rate": [-0.5, 0.5]}, "enforced": False}
    with explorer(limits=limits, policy="random", steps=STEPS) as one:
        drive(one, 100)
        beyond = np.count_nonzero(np.abs(one.states[1:, 1]) > 0.5)
        assert one.counts["beyond"] == beyond > 0
    assert not any("beyond the limits" in text for text in said(caplog))


def test_merged_samples_may_leave_parameters_until_a_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gaussian_process, "MOST_SAMPLES", 60)
    model = {"name": "gaussian_process", "hyperparameters": "evidence"}
    with explorer(model=model, learner={"name": "conditioning", "growth": 3.0}, steps=600) as one:
        drive(one, 600, noise=0.1)
        assert one.counts["refits"] > 0
        assert one.counts["unmoved"] == 0


def test_a_fit_damps_a_step_that_overshoots(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """An exploration whose fits stay goes on as it was made; a new one damps them."""

    def go(one: Explorer) -> Array:
        drive(one, 300, 2, noise=0.0)
        return one.parameters

    options = {"policy": "d_optimal", "learner": "gauss_newton", "seed": 0}
    with explorer(**options) as one:
        damped = go(one)
        assert one.counts["unmoved"] == 0
    journal = tmp_path / "old.jsonl"
    with monkeypatch.context() as patch:
        stays = partial(in_scaled_numbers, damped=False)
        patch.setattr(module, "in_scaled_numbers", lambda spec, **_: stays(spec))
        with explorer(journal=journal, **options) as one:
            before, counts = go(one), one.counts
            assert counts["unmoved"] > 0
    assert sum("no parameter moved" in text for text in said(caplog)) == 1
    journal.write_text(without_checksums(journal).replace(', "overshoot": "stay"', "", 1))
    with explorer(journal=journal, **options) as one:
        assert np.array_equal(one.parameters, before)
        assert not np.array_equal(one.parameters, damped)
        assert one.counts == counts


def test_signs_are_stored_and_shown(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'results.db'}"
    with explorer(steps=STEPS) as one:
        drive(one, 100)
        one.save(url, test=(one.states, one.inputs))
        assert [row[1] for row in content(url)["assessed"]] == ["free_run_error"]
        drive(one, 450, 2)
        one.save(url)
        assert content(url)["assessed"][1:] == [(550, "late", float(one.counts["late"]))]
    with Reader.open(url) as reader:
        key = reader.rows("SELECT trial_key FROM v_trial")[0].trial_key
    page = TestClient(create_app(url), base_url="http://127.0.0.1").get(f"/trials/{key}").text
    assert f"<dt>{SIGNS['late']}</dt><dd>1</dd>" in page
