"""An explorer takes the steps of a trial; what cannot be learned from is counted and left out."""

from __future__ import annotations

import dataclasses
import threading
from typing import Any

import numpy as np
import pytest

import dopt
from dopt import Explorer, TrialSpec
from dopt.errors import ExplorationError, IncompatibleError, ScaleWarning, SpecificationError
from tests.dopt.explorer.plants import MOTOR, following, motor_acceleration
from tests.paths import EXAMPLE
from tests.waiting import PATIENCE_SECONDS

SHORT: dict[str, object] = {"name": "icem", "lookahead": 10, "hold": 5, "stride": 5, "plans": 12}

COIN: dict[str, object] = {"_target_": "tests.dopt.custom_plugins.Coin"}
DESCENT: dict[str, object] = {"_target_": "tests.dopt.custom_plugins.Descent"}

CHOICES: list[tuple[str | dict[str, object], str, str | dict[str, object]]] = [
    ("d_optimal", "mlp", "adam_window"),
    ("random", "mlp", "adam_replay"),
    ("uniform", "mlp", "ekf"),
    (SHORT, "mlp", "gauss_newton"),
    (SHORT, "ensemble", "gauss_newton"),
    ("lookahead", "mlp", "adam_window"),
    ("d_optimal", "rff", "recursive_least_squares"),
    ("gaussian_process", "gaussian_process", "conditioning"),
    ("d_optimal", "affine", "adam_window"),
    (SHORT, "black_box", "gauss_newton"),
    (COIN, "mlp", DESCENT),
]


@pytest.mark.parametrize(("policy", "model", "learner", "path"), [
    *[(*choice, "kernel") for choice in CHOICES],
    ("d_optimal", "mlp", "adam_window", "reference"),
    (COIN, "mlp", DESCENT, "reference"),
])  # fmt: skip
def test_fed_the_states_of_a_trial_it_chooses_its_inputs(
    policy: str | dict[str, object], model: str, learner: str | dict[str, object], path: str
) -> None:
    system = dopt.SYSTEMS["quadrotor"](horizon=12)
    parts: dict[str, Any] = {"model": model, "learner": learner, "seed": 4, "path": path}
    trial = dopt.run_trial(TrialSpec.of_system(system, policy, **parts))
    explorer = Explorer(system, policy=policy, **parts)
    for x, u, x_next in zip(trial.states, trial.inputs, trial.states[1:], strict=False):
        assert explorer.ask(x) == pytest.approx(u, rel=1e-12, abs=1e-12)
        assert explorer.tell(x_next)
    assert explorer.parameters == pytest.approx(trial.parameters, rel=1e-12, abs=1e-12)
    assert explorer.n_steps == 12
    assert np.array_equal(explorer.states, trial.states)


def explored(explorer: Explorer, steps: int, x: Any = (0.1, 0.0)) -> np.ndarray:
    """Let an explorer drive the motor for some steps; return the last state."""
    x = np.array(x)
    for _ in range(steps):
        u = explorer.ask(x)
        x = following(x, u)
        explorer.tell(x)
    return x


def test_the_accelerations_of_a_plant_are_learned() -> None:
    explorer = Explorer(MOTOR, learner="gauss_newton", steps=300)
    states = MOTOR.system(1).grid()
    truth = np.array([motor_acceleration(x) for x in states])
    before = explorer.predict(states)[:, 0] - truth
    explored(explorer, 300)
    after = explorer.predict(states)[:, 0] - truth
    assert np.sqrt(np.mean(after**2)) < 0.05 * np.sqrt(np.mean(before**2))
    assert np.all(np.abs(explorer.inputs) <= MOTOR.gamma * (1 + 1e-9))


def test_the_effect_of_an_input_is_learned() -> None:
    unknown = dataclasses.replace(MOTOR, known={"angle": "rate"})
    with pytest.raises(IncompatibleError, match="a model that learns the effect of the inputs"):
        Explorer(unknown)
    explorer = Explorer(unknown, model="affine", learner="gauss_newton", steps=300)
    explored(explorer, 300)
    states = MOTOR.system(1).grid()
    free, pushed = (
        explorer.predict(states, np.full((len(states), 1), u))[:, 0] for u in (0.0, MOTOR.gamma)
    )
    effect = MOTOR.constants["gain"] * MOTOR.gamma
    assert np.median(np.abs(pushed - free - effect)) < 0.05 * effect
    with pytest.raises(SpecificationError, match="1 states and 2 inputs were given"):
        explorer.predict(states[:1], np.zeros((2, 1)))


def test_accelerations_of_another_size_are_warned_of_once() -> None:
    """A rate that goes up and down by 100 rad/s in each step has accelerations of 5000 rad/s²."""
    explorer = Explorer(MOTOR, policy="random", steps=60)

    def explore() -> None:
        explorer.ask([0.0, 0.0])
        for step in range(60):
            explorer.tell([0.0, 100.0 * ((step + 1) % 2)], applied=[0.0])

    size = r"rate \[rad/s\].* square of 5e\+03 over the first 50 steps"
    said = rf"{size}.*known part.*about 5e\+03 times as large"
    with pytest.warns(ScaleWarning, match=said) as warned:
        explore()
    assert len(warned) == 1


class TestGymnasium:
    """An environment is driven through the same door, by the program that steps it."""

    def test_its_trial_is_explored_without_starting_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.syspath_prepend(str(EXAMPLE))
        from swing import Swing

        system = Swing(horizon=25)
        trial = dopt.run_trial(TrialSpec.of_system(system, "d_optimal", seed=1))

        def start(*_: object) -> Any:
            raise AssertionError("the environment was started")

        monkeypatch.setattr(Swing, "episode", start)
        explorer = Explorer(system, seed=1)
        assert explorer.spec.config.path == "kernel"
        for x, u, x_next in zip(trial.states, trial.inputs, trial.states[1:], strict=False):
            assert explorer.ask(x) == pytest.approx(u, rel=1e-12)
            assert explorer.tell(x_next)
        assert explorer.parameters == pytest.approx(trial.parameters, rel=1e-9, abs=1e-12)


class TestFreeRun:
    """Predictions of another run without measurements."""

    def recorded(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        inputs = 3.0 * np.sin(0.3 * np.arange(steps))[:, None]
        states = [np.array([0.5, 0.0])]
        for u in inputs:
            states.append(following(states[-1], u))
        return np.array(states), inputs

    def test_a_learned_model_predicts_it(self) -> None:
        explorer = Explorer(MOTOR, learner="gauss_newton", steps=300)
        before = explorer.free_run_error(*self.recorded(200), steps=20)
        explored(explorer, 300)
        after = explorer.free_run_error(*self.recorded(200), steps=20)
        assert after < 0.02 < 0.2 < before

    def test_a_perfect_model_has_none(self, monkeypatch: pytest.MonkeyPatch) -> None:
        explorer = Explorer(MOTOR, steps=5)
        truth = lambda states, _: np.array([[motor_acceleration(x)] for x in states])  # noqa: E731
        monkeypatch.setattr(explorer, "predict", truth)
        assert explorer.free_run_error(*self.recorded(105), steps=20) < 1e-12

    @pytest.mark.parametrize("steps", [0, 31])
    def test_runs_that_are_too_short_are_refused(self, steps: int) -> None:
        with pytest.raises(SpecificationError, match=r"\(31, 2\).*\(T \+ 1, 2\)"):
            Explorer(MOTOR, steps=5).free_run_error(*self.recorded(30), steps=steps)


def test_the_same_question_has_the_same_answer() -> None:
    explorer = Explorer(MOTOR, policy="random", steps=10)
    first = explorer.ask([0.1, 0.0])
    assert np.array_equal(explorer.ask([0.1, 0.0]), first)
    assert explorer.counts["jumps"] == 0


def test_the_applied_input_is_learned_from() -> None:
    """An input that a saturated amplifier has halved explains the half of the acceleration."""
    cut, whole = (Explorer(MOTOR, policy="random", steps=5) for _ in range(2))
    x = np.array([0.1, 0.0])
    cut.ask(x)
    whole.ask(x)
    applied = np.array([0.5])
    cut.tell(following(x, applied), applied=applied)
    whole.tell(following(x, applied))
    assert cut.inputs[0] == 0.5
    assert cut.errors[0] == pytest.approx(abs(motor_acceleration(x) - cut_prediction(x)), rel=1e-9)
    assert not np.array_equal(cut.parameters, whole.parameters)


def cut_prediction(x: np.ndarray) -> float:
    return float(Explorer(MOTOR, policy="random", steps=5).predict(x)[0, 0])


def test_a_late_plan_is_replaced_by_the_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer(MOTOR, steps=20, deadline=PATIENCE_SECONDS, fallback=[0.25])
    x = np.array([0.1, 0.0])
    x = following(x, explorer.ask(x))
    explorer.tell(x)
    may_end, plan = threading.Event(), explorer._state.steps.plan_input

    def slow(t: int) -> None:
        may_end.wait(PATIENCE_SECONDS)
        plan(t)

    monkeypatch.setattr(explorer._state.steps, "plan_input", slow)
    monkeypatch.setattr(explorer._planner, "_deadline", 0.05)
    assert explorer.ask(x) == 0.25
    assert not may_end.is_set()
    may_end.set()
    assert explorer.tell(following(x, np.array([0.25])))
    assert explorer.counts["missed"] == 1
    assert explorer.inputs[1] == 0.25
    explorer.close()


def test_a_plan_in_time_is_that_without_a_deadline() -> None:
    with (
        Explorer(MOTOR, steps=20, deadline=PATIENCE_SECONDS) as punctual,
        Explorer(MOTOR, steps=20) as plain,
    ):
        assert np.array_equal(explored(punctual, 20), explored(plain, 20))


class TestRefusals:
    """What was given, what is expected, what to do."""

    def test_a_state_before_any_input(self) -> None:
        explorer = Explorer(MOTOR, steps=5)
        assert not explorer.tell([0.0, 0.0])  # where the exploration begins
        with pytest.raises(ExplorationError, match=r"call ask\(\) first"):
            explorer.tell([0.0, 0.0])

    def test_more_steps_than_there_is_room_for(self) -> None:
        explorer = Explorer(MOTOR, steps=2)
        x = explored(explorer, 2)
        with pytest.raises(ExplorationError, match="all 2 steps"):
            explorer.ask(x)
        with pytest.raises(ExplorationError, match="all 2 steps"):
            explorer.tell(x, applied=[0.0])

    @pytest.mark.parametrize(
        "state", [[0.0], [[0.0, 0.0]], ["a", "b"], [True, False], [[0.0], [1.0, 2.0]]]
    )
    def test_states_of_another_kind(self, state: Any) -> None:
        with pytest.raises(SpecificationError, match="2 real numbers are expected"):
            Explorer(MOTOR, steps=2).ask(state)

    def test_an_input_that_is_not_finite(self) -> None:
        explorer = Explorer(MOTOR, steps=2)
        explorer.ask([0.0, 0.0])
        with pytest.raises(SpecificationError, match="applied is \\[nan\\]"):
            explorer.tell([0.0, 0.0], applied=[np.nan])

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            ({"tolerance": -1.0}, "tolerance is -1.0"),
            ({"tolerance": 5.0}, "above 0 and below 1"),
            ({"tolerance": np.nan}, "tolerance is nan"),
            ({"deadline": 0.0}, "deadline is 0.0"),
            ({"deadline": "a"}, "deadline is 'a'"),
            ({"fallback": [np.nan]}, "fallback is"),
            ({"fallback": [7.0]}, "at most 6"),
            ({"fallback": [1.0, 1.0]}, "1 real number is expected"),
        ],
    )
    def test_settings_outside_their_bounds(self, given: dict[str, Any], said: str) -> None:
        with pytest.raises(SpecificationError, match=said):
            Explorer(MOTOR, **given)

    def test_states_of_another_size_to_predict_at(self) -> None:
        with pytest.raises(SpecificationError, match=r"\(N, 2\) is expected"):
            Explorer(MOTOR, steps=2).predict([[1.0, 2.0, 3.0]])

    def test_parts_that_do_not_go_together(self) -> None:
        with pytest.raises(IncompatibleError):
            Explorer(MOTOR, policy="oracle")

    def test_a_trial_of_a_plant(self) -> None:
        spec = TrialSpec.of_system(MOTOR.system(5), "d_optimal")
        with pytest.raises(SpecificationError, match=r"drive it with dopt\.Explorer"):
            dopt.run_trial(spec)

    def test_parameters_that_are_not_finite(self) -> None:
        learner = {"name": "adam_window", "learning_rate": 1e300}
        explorer = Explorer(MOTOR, learner=learner, policy="random", steps=50)
        with pytest.raises(ExplorationError, match="not finite"):
            explored(explorer, 50)


def test_a_custom_policy_and_learner_are_driven_too() -> None:
    own = "tests.dopt.custom_plugins"
    policy, learner = {"_target_": f"{own}.Copy"}, {"_target_": f"{own}.Descent"}
    system = dopt.SYSTEMS["pendulum"](horizon=8)
    trial = dopt.run_trial(TrialSpec.of_system(system, policy, learner=learner, seed=2))
    explorer = Explorer(system, policy=policy, learner=learner, seed=2)
    for x, u, x_next in zip(trial.states, trial.inputs, trial.states[1:], strict=False):
        assert np.array_equal(explorer.ask(x), u)
        explorer.tell(x_next)
    assert np.array_equal(explorer.parameters, trial.parameters)
