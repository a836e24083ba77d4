"""Measurements that are late, lost, noisy or partial, and what an explorer does then."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer, Plant
from dopt.errors import IncompatibleError, SpecificationError
from dopt.explorer.saving import free_run_error
from dopt.types import Array
from tests.dopt.explorer.plants import MOTOR, following, motor_acceleration


def begun(**given: Any) -> tuple[Explorer, np.ndarray]:
    """Return an explorer after one step at 0.02 s, and its state."""
    explorer = Explorer(MOTOR, steps=20, **given)
    x = np.array([0.1, 0.0])
    u = explorer.ask(x, time=0.0)
    x = following(x, u)
    assert explorer.tell(x, time=0.02)
    return explorer, x


def said(log: pytest.LogCaptureFixture, words: str) -> int:
    return sum(words in record.message for record in log.records)


def test_repeated_and_older_states_change_nothing() -> None:
    explorer, x = begun()
    explorer.ask(x, time=0.02)
    before = explorer.parameters
    assert not explorer.tell(x, time=0.02)
    assert not explorer.tell(x + 1.0, time=0.01)
    assert np.array_equal(explorer.parameters, before)
    assert (explorer.counts["repeated"], explorer.counts["out_of_order"]) == (1, 1)
    u = explorer.ask(x, time=0.02)
    assert np.array_equal(explorer.ask([0.1, 0.0], time=0.0), u)  # the answer to the present one
    assert explorer.counts["out_of_order"] == 2
    assert explorer.tell(following(x, u))
    assert explorer._state.time == pytest.approx(0.04)  # which goes on with the clock


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e5])
def test_unusable_states_end_a_transition(value: float) -> None:
    explorer, x = begun(fallback=[0.3])
    explorer.ask(x, time=0.02)
    before = explorer.parameters
    assert not explorer.tell([0.0, value], time=0.04)
    assert not explorer.tell(x, time=0.06)  # from which the next step is taken
    assert np.array_equal(explorer.parameters, before)
    assert explorer.counts["unusable"] == 1
    assert explorer.tell(following(x, explorer.ask(x)), time=0.08)
    assert explorer.ask([0.0, value], time=0.08) == 0.3
    assert explorer.counts["unusable"] == 2
    assert not explorer.tell([0.2, 0.0], time=0.1)  # from which it goes on


@pytest.mark.parametrize("when", [0.025, 0.06])
def test_too_early_and_too_late_states_are_gaps(when: float) -> None:
    explorer, x = begun()
    u = explorer.ask(x, time=0.02)
    before = explorer.parameters
    assert not explorer.tell(following(x, u), time=when)
    assert np.array_equal(explorer.parameters, before)
    assert (explorer.counts["gaps"], explorer.n_steps) == (1, 1)


def test_an_infinite_acceleration_is_unusable() -> None:
    """The known part is infinite at one state: what is seen there is no number."""
    known = {"angle": "rate", "rate": "gain * voltage + 1 / angle"}
    explorer = Explorer(dataclasses.replace(MOTOR, known=known), steps=20, learner="gauss_newton")
    explorer.ask([0.0, 0.0])
    assert not explorer.tell([0.1, 0.0], applied=[1.0])
    assert (explorer.counts["unusable"], explorer.n_steps) == (1, 0)


def test_an_angle_is_followed_over_many_turns() -> None:
    """Measured over one turn, and beyond the limit over many."""
    turning = [0.0, 2.5, 5.0, 7.5]
    wrapped = [(a + np.pi) % (2 * np.pi) - np.pi for a in turning]
    one, many = (Explorer(MOTOR, steps=20) for _ in range(2))
    for explorer, angles in ((one, wrapped), (many, [a + 2e4 * np.pi for a in turning])):
        explorer.ask([angles[0], 125.0])
        assert all(explorer.tell([a, 125.0], applied=[1.0]) for a in angles[1:])
    assert one.states[:, 0] == pytest.approx(turning)
    assert one.parameters == pytest.approx(many.parameters, rel=1e-3)


@pytest.mark.parametrize(
    ("told", "seconds", "words"),
    [(True, 20.0, "last 20 states"), (False, None, "tell() each state")],
)
def test_states_in_vain_or_never_told_are_said_once(
    caplog: pytest.LogCaptureFixture, told: bool, seconds: float | None, words: str
) -> None:
    """Such as times in milliseconds."""
    explorer = Explorer(MOTOR, steps=40)
    for step in range(30):
        explorer.ask([0.1 * step, 0.0], time=seconds and seconds * step)
        if told:
            explorer.tell([0.1 * step, 0.0], time=20.0 * (step + 1))
    assert said(caplog, words) == 1


def test_a_reset_follows_a_clock_that_began_anew(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    journal = tmp_path / "run.jsonl"
    with Explorer(MOTOR, steps=40, journal=journal) as explorer:
        explorer.ask([0.1, 0.0], time=1e3)
    with Explorer(MOTOR, steps=40, journal=journal) as explorer:
        for step in range(30):
            explorer.tell([0.1, 0.1 * step], time=0.02 * step)
            explorer.ask([0.1, 0.1 * step], time=0.02 * step)
        assert explorer.counts["out_of_order"] == 30
        assert said(caplog, "call reset() if their clock restarted") == 1
        explorer.reset()
        x = np.array([0.1, 0.0])
        assert explorer.tell(following(x, explorer.ask(x, time=0.001)), time=0.021)
        assert (explorer.counts["resets"], explorer.counts["learned"]) == (1, 1)


@pytest.mark.parametrize("timed", [False, True])
def test_a_state_that_is_told_and_asked_about_is_counted_once(timed: bool) -> None:
    explorer, x = begun()
    bad = [("unusable", [7.0, np.nan], 0.04), ("unusable", [0.0, 1e5], 0.06)]
    if timed:
        bad = [("repeated", x + 1.0, 0.02), ("out_of_order", x + 1.0, 0.01), *bad]
    before = explorer.parameters
    for kind, state, when in bad:
        count = explorer.counts[kind]
        for _ in range(2):
            given = np.array(state)
            if explorer.counts[kind] == count:
                assert not explorer.tell(given, time=when if timed else None)
            explorer.ask(given, time=when if timed else None)
            given[:] = 0.0
        assert explorer.counts[kind] == count + 1
    assert np.array_equal(explorer.parameters, before)
    assert not explorer.tell(x, time=0.08)
    assert explorer.tell(following(x, explorer.ask(x)), time=0.10)


@pytest.mark.parametrize("time", [np.nan, np.inf, "1", True, [0.1]])
def test_times_that_are_none_are_refused(time: Any) -> None:
    explorer, x = begun()
    for call in (explorer.tell, explorer.ask):
        with pytest.raises(SpecificationError, match="finite number of seconds"):
            call(x, time=time)


def test_dt_is_measured() -> None:
    """With jitter of a quarter of dt the accelerations are seen as they are."""
    explorer, x = begun()
    u = explorer.ask(x, time=0.02)
    predicted = explorer.predict(x)[0, 0]
    assert explorer.tell(following(x, u, 0.025), time=0.045)
    assert explorer.errors[1] == pytest.approx(abs(motor_acceleration(x) - predicted), rel=1e-9)


def test_a_state_that_was_not_told_is_a_jump() -> None:
    explorer, _ = begun()
    explorer.ask([1.0, 0.0], time=5.0)
    assert explorer.counts["jumps"] == 1
    assert explorer.tell(following(np.array([1.0, 0.0]), explorer.ask([1.0, 0.0])), time=5.02)
    assert np.array_equal(explorer.states[1], [1.0, 0.0])


DEGREE = math.pi / 180
ENCODER = dataclasses.replace(MOTOR, measured={"angle": DEGREE})
JOINT: dict[str, Any] = {
    "policy": {"name": "d_optimal", "regularization": 3.0},
    "learner": {"name": "joint_ekf", "refit_every": 40},
}


def driven(explorer: Explorer, steps: int, seed: int = 0, start: Array | None = None) -> Array:
    """Take steps with a simulated motor; return its last state."""
    rng = np.random.default_rng(seed)
    x = np.array([0.1, 0.0]) if start is None else start
    y = x[:1] + DEGREE * rng.standard_normal(1)
    for _ in range(steps):
        u = explorer.ask(y)
        x = following(x, u)
        y = x[:1] + DEGREE * rng.standard_normal(1)
        assert explorer.tell(y)
    return x


def error(explorer: Explorer) -> float:
    """Return the root mean square error of the learned accelerations beside their size."""
    rng = np.random.default_rng(5)
    states = np.column_stack([rng.uniform(-math.pi, math.pi, 300), rng.uniform(-6, 6, 300)])
    truth = np.array([[motor_acceleration(x)] for x in states]).reshape(300, 1)
    predicted = explorer.predict(states)
    return float(np.sqrt(np.mean((predicted - truth) ** 2) / np.mean(truth**2)))


def test_it_learns_and_estimates_the_rate() -> None:
    explorer = Explorer(ENCODER, steps=500, **JOINT)
    x = driven(explorer, 400)
    assert explorer.counts["learned"] == 400
    assert error(explorer) < 0.2
    assert np.abs(explorer.states[-1] - x)[0] < 4 * DEGREE
    assert np.abs(explorer.states[-1] - x)[1] < 0.5
    # once the model is good, what is predicted differs from what is measured by the noise
    assert 0.5 < float(np.sqrt(np.mean(explorer.errors[-100:] ** 2))) < 2.0


@pytest.mark.parametrize("learner", ["joint_ekf", "adam_window"])
def test_a_journal_replays_to_the_same_parameters(learner: str, tmp_path: Path) -> None:
    given = JOINT if learner == "joint_ekf" else {"learner": learner}
    path = tmp_path / "run.jsonl"
    with Explorer(ENCODER, steps=100, journal=path, **given) as explorer:
        x = driven(explorer, 50)
        explorer.reset()
        driven(explorer, 10, 1, x)
        parameters, states = explorer.parameters.copy(), explorer.states
    with Explorer(ENCODER, steps=100, journal=path, **given) as again:
        assert np.array_equal(again.parameters, parameters)
        assert np.array_equal(again.states, states)


def test_a_question_later_than_the_measurement_keeps_the_estimate() -> None:
    late, prompt = (Explorer(ENCODER, steps=60, **JOINT) for _ in range(2))
    rng, x = np.random.default_rng(3), np.array([0.1, 0.0])
    y = x[:1]
    for t in range(50):
        u = late.ask(y, time=0.02 * t + 0.002)
        assert np.array_equal(u, prompt.ask(y, time=0.02 * t))
        x = following(x, u)
        y = x[:1] + DEGREE * rng.standard_normal(1)
        late.tell(y, time=0.02 * (t + 1) + 0.002)
        prompt.tell(y, time=0.02 * (t + 1))
    np.testing.assert_allclose(late.states, prompt.states, atol=1e-9)


def test_questions_about_other_measurements_are_warned_of(caplog: Any) -> None:
    explorer = Explorer(ENCODER, steps=60, **JOINT)
    for t in range(12):
        explorer.ask([0.1 + 0.001 * t])
        explorer.tell([0.1])
    assert sum("ask with the one told last" in line for line in caplog.messages) == 1


@pytest.mark.parametrize("learner", ["joint_ekf", "adam_window"])
def test_filters_begin_anew_after_a_reset(learner: str) -> None:
    """What comes after it is estimated as from the start of an exploration."""
    given = JOINT if learner == "joint_ekf" else {"learner": learner}
    explorer, fresh = (Explorer(ENCODER, steps=60, **given) for _ in range(2))
    driven(explorer, 20)
    explorer.reset()
    for one in (explorer, fresh):
        one.ask([0.3])
        assert one.tell([0.31], applied=[1.0])
    if learner == "adam_window":  # the filter over both predicts with what it has learned
        np.testing.assert_array_equal(explorer.states[-1], fresh.states[-1])
    estimate: Any = explorer._state.steps.state.estimate  # type: ignore[attr-defined]
    assert estimate.starts[20, 0] == 0.3


def test_an_angle_may_be_measured_over_one_turn() -> None:
    turning, unrolled = (Explorer(ENCODER, steps=80, **JOINT) for _ in range(2))
    rng, x = np.random.default_rng(3), np.array([3.0, 5.0])
    y = x[:1]
    for _ in range(60):
        once = (y + math.pi) % (2 * math.pi) - math.pi
        u = turning.ask(once)
        assert np.array_equal(u, unrolled.ask(y))
        x = following(x, u)
        y = x[:1] + DEGREE * rng.standard_normal(1)
        turning.tell((y + math.pi) % (2 * math.pi) - math.pi)
        unrolled.tell(y)
    np.testing.assert_allclose(turning.parameters, unrolled.parameters, atol=1e-6)


def test_a_plant_says_what_is_measured_in_the_order_of_its_states() -> None:
    section = ENCODER.to_section()
    assert section["measured"] == {"angle": DEGREE}
    assert Plant.from_section(section | {"horizon": 10}).measured_states == (0,)
    assert "measured" not in MOTOR.to_section()
    both = dataclasses.replace(MOTOR, measured={"rate": 0.1, "angle": DEGREE}).system(10)
    assert both.measured_states == (0, 1)
    assert both.measurement_noise == (DEGREE, 0.1)
    with pytest.raises(SpecificationError, match="shape"):
        Explorer(ENCODER, steps=10, **JOINT).ask([0.1, 0.0])
    wrong: list[tuple[Any, str]] = [({"place": 1.0}, "place"), ({"angle": 0.0}, "positive")]
    for measured, words in [*wrong, (["angle"], "mapping")]:
        with pytest.raises(SpecificationError, match=words):
            dataclasses.replace(MOTOR, measured=measured)


def test_a_rate_without_its_angle_needs_the_filter() -> None:
    gyroscope = dataclasses.replace(MOTOR, measured={"rate": 0.1})
    with pytest.raises(IncompatibleError, match="joint_ekf"):
        Explorer(gyroscope, steps=10)
    Explorer(gyroscope, steps=10, **JOINT)


def recorded(steps: int, noise: float) -> tuple[Array, Array, Array]:
    """Return states, measured angles over one turn, and inputs of a run of the motor."""
    rng = np.random.default_rng(9)
    inputs = np.repeat(rng.uniform(-6, 6, (-(-steps // 10), 1)), 10, axis=0)[:steps]
    states = [np.array([2.0, 5.0])]
    for u in inputs:
        states.append(following(states[-1], u))
    angles = np.array(states)[:, :1] + noise * rng.standard_normal((steps + 1, 1))
    return np.array(states), (angles + math.pi) % (2 * math.pi) - math.pi, inputs


def true_motor(states: Array, inputs: Array) -> Array:  # noqa: ARG001  # they are known
    return np.array([[motor_acceleration(x)] for x in states])


def test_a_run_of_measured_angles_is_predicted_by_the_truth() -> None:
    """Without noise the rate is found from the angles, and what remains is of its order."""
    spec = Explorer(dataclasses.replace(MOTOR, measured={"angle": 1e-6}), steps=10, **JOINT).spec
    _, angles, inputs = recorded(300, 1e-6)
    right = free_run_error(spec, true_motor, angles, inputs, steps=30)
    wrong = free_run_error(spec, lambda x, u: 0.9 * true_motor(x, u), angles, inputs, steps=30)
    assert right < 1e-4 < 0.01 * wrong


def test_the_error_of_measured_angles_is_nearly_that_of_the_states() -> None:
    explorer = Explorer(ENCODER, steps=400, **JOINT)
    _, angles, inputs = recorded(400, DEGREE)
    before = explorer.free_run_error(angles, inputs)
    driven(explorer, 300)
    states, _, _ = recorded(400, DEGREE)
    after = explorer.free_run_error(angles, inputs)
    assert after < 0.3 * before
    assert after == pytest.approx(explorer.free_run_error(states, inputs), rel=0.3)
    with pytest.raises(SpecificationError, match="of measured states alone twice as many"):
        explorer.free_run_error(angles[:80], inputs[:79])
