"""Explorer: arguments, steps, plans, the guide, and the program of a rig."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import numpy as np
import pytest

import dopt
from dopt import Explorer, TrialSpec
from dopt.errors import ExplorationError, IncompatibleError, ScaleWarning, SpecificationError
from dopt.explorer.explorer import uninterrupted
from dopt.policies.base import CustomPolicy, Planner
from dopt.systems import Pendulum, System
from dopt.trial_view import TrialView
from dopt.types import Array
from orchestrate.store import Reader
from tests.dopt.explorer.plants import MOTOR, drive, explorer, following, motor_acceleration
from tests.paths import EXAMPLE, ROOT
from tests.waiting import PATIENCE_SECONDS, until

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


def recorded(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states and inputs of another run."""
    inputs = 3.0 * np.sin(0.3 * np.arange(steps))[:, None]
    states = [np.array([0.5, 0.0])]
    for u in inputs:
        states.append(following(states[-1], u))
    return np.array(states), inputs


def test_the_accelerations_of_a_plant_are_learned_and_predict_another_run() -> None:
    explorer = Explorer(MOTOR, learner="gauss_newton", steps=300)
    states = MOTOR.system(1).grid()
    truth, sizes, errors = np.array([motor_acceleration(x) for x in states]), [], []
    for steps in (0, 300):
        drive(explorer, steps)
        sizes.append(np.sqrt(np.mean((explorer.predict(states)[:, 0] - truth) ** 2)))
        errors.append(explorer.free_run_error(*recorded(200), steps=20))
    assert sizes[1] < 0.05 * sizes[0]
    assert errors[1] < 0.02 < 0.2 < errors[0]
    assert np.all(np.abs(explorer.inputs) <= MOTOR.gamma * (1 + 1e-9))


def test_the_effect_of_an_input_is_learned() -> None:
    unknown = dataclasses.replace(MOTOR, known={"angle": "rate"})
    with pytest.raises(IncompatibleError, match="a model that learns the effect of the inputs"):
        Explorer(unknown)
    explorer = Explorer(unknown, model="affine", learner="gauss_newton", steps=300)
    drive(explorer, 300)
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
    said = rf"{size}.*known part.*half-width of the box .* about 3e\+03 times as large"
    with pytest.warns(ScaleWarning, match=said) as warned:
        explore()
    assert len(warned) == 1


def test_an_environment_is_explored_without_starting_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment is driven through the same door, by the program that steps it."""
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


def test_the_free_run_of_a_perfect_model_has_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer(MOTOR, steps=5)
    truth = lambda states, _: np.array([[motor_acceleration(x)] for x in states])  # noqa: E731
    monkeypatch.setattr(explorer, "predict", truth)
    assert explorer.free_run_error(*recorded(105), steps=20) < 1e-12


def test_the_applied_input_is_learned_from() -> None:
    """An input that a saturated amplifier has halved explains the half of the acceleration."""
    cut, whole = (Explorer(MOTOR, policy="random", steps=5) for _ in range(2))
    x, applied = np.array([0.1, 0.0]), np.array([0.5])
    predicted = float(cut.predict(x)[0, 0])
    assert np.array_equal(cut.ask(x), whole.ask(x))
    cut.tell(following(x, applied), applied=applied)
    whole.tell(following(x, applied))
    assert cut.inputs[0] == 0.5
    assert cut.errors[0] == pytest.approx(abs(motor_acceleration(x) - predicted), rel=1e-9)
    assert not np.array_equal(cut.parameters, whole.parameters)


def test_calls_out_of_order_are_refused() -> None:
    explorer = Explorer(MOTOR, steps=2)
    assert not explorer.tell([0.0, 0.0])  # where the exploration begins
    with pytest.raises(ExplorationError, match=r"call ask\(\) first"):
        explorer.tell([0.0, 0.0])
    x = drive(explorer, 2)
    with pytest.raises(ExplorationError, match="all 2 steps"):
        explorer.ask(x)
    with pytest.raises(ExplorationError, match="all 2 steps"):
        explorer.tell(x, applied=[0.0])
    with pytest.raises(SpecificationError, match=r"drive it with dopt\.Explorer"):
        dopt.run_trial(TrialSpec.of_system(MOTOR.system(5), "d_optimal"))


STATES, INPUTS = np.cumsum(np.ones((101, 2)), axis=0), np.ones((100, 1))
NO_NUMBERS: list[Any] = ["a", [[1.0, 2.0], [3.0]], [1j, 2.0], None, {}, [["a", "b"]]]
NO_STATES: list[Any] = [[0.0], [[0.0, 0.0]], ["a", "b"], [True, False], [[0.0], [1.0, 2.0]]]
NO_ARRAY = "an array of real numbers is expected"


@pytest.mark.parametrize(
    ("call", "given", "said"),
    [
        *(("ask", [state], "2 real numbers are expected") for state in NO_STATES),
        *(("predict", [given], NO_ARRAY) for given in NO_NUMBERS),
        *(("free_run_error", [given, INPUTS], NO_ARRAY) for given in NO_NUMBERS),
        *(("free_run_error", [STATES, given], NO_ARRAY) for given in NO_NUMBERS),
        *(
            ("free_run_error", [STATES, INPUTS, steps], r"^steps is .*a whole number")
            for steps in (2.5, "5", True, None)
        ),
        *(
            ("free_run_error", [*recorded(30), steps], r"\(31, 2\).*\(T \+ 1, 2\)")
            for steps in (0, 31)
        ),
        ("free_run_error", [5, 5], r"shape \(1,\)"),
        ("predict", [[[1.0, 2.0, 3.0]]], r"\(N, 2\) is expected"),
        ("tell", [[0.0, 0.0], [np.nan]], r"applied is \[nan\]"),
    ],
)
def test_arguments_that_are_none_are_refused(call: str, given: list[Any], said: str) -> None:
    explorer = Explorer(MOTOR, steps=5)
    if call == "tell":
        explorer.ask([0.0, 0.0])
    with pytest.raises(SpecificationError, match=said):
        getattr(explorer, call)(*given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"tolerance": -1.0}, "tolerance is -1.0"),
        ({"tolerance": 5.0}, "above 0 and below 1"),
        ({"tolerance": np.nan}, "tolerance is nan"),
        ({"deadline": 0.0}, "deadline is 0.0"),
        ({"deadline": "a"}, "deadline is 'a'"),
        ({"deadline": 1e12}, "deadline is 1000000000000.0, but a number above 0 and below"),
        ({"deadline": [1.0, [2.0]]}, "deadline is"),
        ({"fallback": [np.nan]}, "fallback is"),
        ({"fallback": [7.0]}, "at most 6"),
        ({"fallback": [1.0, 1.0]}, "1 real number is expected"),
        ({"policy": None}, "'policy' is None"),
        ({"policy": "oracle"}, "needs dynamics that are linear"),
        ({"learner": None}, "'learner' is None"),
        ({"model": 5}, "'model' is 5"),
        ({"journal": 5}, "journal is 5, but the path of a file"),
        *(
            ({"steps": steps}, r"^steps is .* from 1 to 10,000,000 is expected")
            for steps in (2.5, 0, -1, True, "5", None, 10**8, 10**30, np.float64(5.0))
        ),
        *(
            ({"plant": plant}, r"^plant is .*, but a plant or a system")
            for plant in ("pendulum", {"name": "pendulum"}, dopt.Plant, Pendulum, None)
        ),
    ],
)
def test_settings_outside_their_bounds_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        Explorer(**({"plant": MOTOR} | given))


def test_numbers_of_numpy_describe_the_same_exploration() -> None:
    plain: dict[str, Any] = {"gamma": 6, "dt": 0.25, "box": {"rate": 30}, "limit": 1000}
    numpy = {
        "gamma": np.int64(6),
        "dt": np.float32(0.25),
        "box": {"rate": np.int64(30)},
        "limit": np.int64(1000),
        "velocity_cutoff": np.float32(2.0),
        "constants": {"gain": np.float32(5.0)},
    }
    expected = Explorer(dataclasses.replace(MOTOR, **plain), steps=10, seed=3)
    given = Explorer(
        dataclasses.replace(MOTOR, **numpy),
        steps=np.int64(10),
        seed=np.int64(3),
        tolerance=np.float32(0.5),
        model={"name": "mlp", "width": np.int64(16)},
    )
    assert given.spec.trial_key == expected.spec.trial_key
    assert given.spec.to_mapping() == expected.spec.to_mapping()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_test_run_without_an_error_is_not_stored(value: float, tmp_path: Path) -> None:
    url, states, inputs = f"sqlite:///{tmp_path}/results.db", STATES.copy(), INPUTS.copy()
    with explorer() as run:
        drive(run, 5)
        states[3, 0] = inputs[7, 0] = value
        with pytest.raises(SpecificationError, match=r"row 3 of the states .* finite numbers"):
            run.save(url, test=(states, INPUTS))
        with pytest.raises(SpecificationError, match=r"row 7 of the inputs .* finite numbers"):
            run.save(url, test=(STATES, inputs))
        with pytest.raises(SpecificationError, match="in which nothing changes"):
            run.save(url, test=(np.zeros((101, 2)), INPUTS))
        assert np.isfinite(run.free_run_error(STATES, INPUTS, np.int64(20)))


@dataclass(frozen=True, kw_only=True)
class Remembering(CustomPolicy):
    """Notes the steps at which it is asked for an input."""

    name: ClassVar[str] = "remembering"
    steps: ClassVar[list[int]] = []

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return RememberingPlanner()


class RememberingPlanner(Planner):
    def choose(self, view: TrialView) -> Array:
        Remembering.steps.append(view.t)
        return np.zeros(1)


def told_without_questions(policy: str | dict[str, Any], steps: int) -> tuple[Explorer, Array]:
    """Return an exploration of inputs that were chosen elsewhere, and its last state."""
    explorer, x = Explorer(MOTOR, policy=policy, steps=30), np.array([0.1, 0.0])
    explorer.ask(x)
    for t in range(steps):
        u = np.array([3.0 * (-1) ** t])
        x = following(x, u)
        assert explorer.tell(x, applied=u)
    return explorer, x


def test_a_policy_that_may_remember_plans_at_each_step_also_where_none_is_asked() -> None:
    Remembering.steps.clear()
    told_without_questions({"_target_": f"{__name__}.Remembering"}, 5)
    assert Remembering.steps == [1, 2, 3, 4]


def test_episodes_are_planned_before_the_first_question() -> None:
    policy = {**SHORT, "name": "episodic", "replan_every": 5}
    explorer, x = told_without_questions(policy, 2)
    assert abs(explorer.ask(x)[0]) > 0.1


@pytest.mark.parametrize("deadline", [None, PATIENCE_SECONDS])
def test_a_plan_that_fails_is_said_once_and_costs_no_state(deadline: float | None) -> None:
    explorer = Explorer(MOTOR, policy="d_optimal", steps=30, deadline=deadline)
    x = drive(explorer, 3)
    planner: Any = explorer._planner
    make, planner._make = planner._make, Mock(side_effect=RuntimeError("no plan"))
    with pytest.raises(RuntimeError, match="no plan"):
        explorer.ask(x)
    planner._make = make
    assert explorer.tell(following(x, np.array([1.0])), applied=[1.0])
    explorer.close()


@pytest.mark.filterwarnings("ignore::dopt.errors.ScaleWarning")
@pytest.mark.parametrize(("dt", "said"), [(1e-6, 1), (PATIENCE_SECONDS, 0)])
def test_calls_that_take_longer_than_a_step_are_said_once(
    dt: float, said: int, caplog: pytest.LogCaptureFixture
) -> None:
    plant = dataclasses.replace(MOTOR, dt=dt)
    with Explorer(plant, policy="random", deadline=PATIENCE_SECONDS) as explorer:
        for _ in range(200):
            explorer.ask([0.0, 1.0])
            explorer.tell([0.0, 1.0])
    slow = [m for m in caplog.messages if "but a step is to take" in m]
    assert len(slow) == said


def test_ctrl_c_during_a_call_that_fails_is_not_lost() -> None:
    @uninterrupted()
    def fail() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        raise SpecificationError("a shape is wrong")

    with pytest.raises(KeyboardInterrupt):
        fail()


BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "plants.md").read_text(), re.DOTALL)


def test_its_lines_run_as_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    state = {"x": np.zeros(2), "u": np.zeros(1), "time": 0.0}

    def measure() -> tuple[Any, Any]:
        return state["x"].copy(), state["time"]

    def apply(u: np.ndarray) -> None:
        """Hold an input for one time step of a motor."""
        angle, rate = state["x"]
        slope = np.array([rate, 40.0 * u[0] - 20.0 * np.sin(angle) - 2.0 * rate])
        state["x"], state["time"] = state["x"] + 0.005 * slope, state["time"] + 0.005

    names: dict[str, Any] = {"measure": measure, "apply": apply}
    for block in BLOCKS:
        shorter = block.replace("2000", "150")
        exec(compile(shorter, "plants.md", "exec"), names)
    explorer = names["explorer"]
    assert explorer.n_steps == explorer.counts["learned"] == 150
    assert (tmp_path / "motor.jsonl").stat().st_size > 0
    assert "'learned': 150" in capsys.readouterr().out


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    import rig

    return rig


def started(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, EXAMPLE / "rig.py", *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def reopened(rig: object, journal: Path) -> Explorer:
    return Explorer(rig.MOTOR, steps=60_000, journal=journal)  # type: ignore[attr-defined]


def wait_for_steps(journal: Path, count: int, after: str = "") -> None:
    """Wait until the journal has so many learned steps after a text."""

    def are_there() -> bool:
        content = journal.read_text() if journal.exists() else ""
        return after in content and content[content.find(after) :].count('"learn"') >= count

    until(are_there, lambda: f"there are no {count} steps after '{after}'")


def test_either_end_is_killed_and_the_exploration_goes_on(rig: object, tmp_path: Path) -> None:
    journal = tmp_path / "rig.jsonl"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    motor = ["--role", "motor", "--port", port, "--loss", "0.05", "--jitter", "0.2"]
    explorer = ["--role", "explorer", "--port", port, "--journal", str(journal)]
    running = [started(*motor), started(*explorer, "--seconds", "600")]
    try:
        wait_for_steps(journal, 100)
        running[0].send_signal(signal.SIGKILL)
        running.append(started(*motor))
        wait_for_steps(journal, 101, after="resets")
        running[1].send_signal(signal.SIGKILL)
        running[1].communicate(timeout=PATIENCE_SECONDS)
        with reopened(rig, journal) as after:
            told, parameters = after.n_steps, after.parameters
        assert told > 200, after.counts
        assert after.counts["resets"] == 1
        assert after.counts["gaps"] > 0  # where datagrams were lost
        learned = journal.read_text().count('"learn"')
        running.append(started(*explorer, "--seconds", "600"))
        wait_for_steps(journal, learned + 1)
        running[-1].kill()
        said = running[-1].communicate(timeout=PATIENCE_SECONDS)[0]
        assert f"{told} steps in the journal" in said
    finally:
        for process in running:
            process.kill()
            process.communicate()
    with reopened(rig, journal) as again:
        assert again.n_steps > told
        assert not np.array_equal(again.parameters, parameters)
        assert np.isfinite(again.errors).all()


def test_it_is_saved_and_its_answers_are_drawn(rig: object, tmp_path: Path) -> None:
    url, picture = f"sqlite:///{tmp_path}/results.db", tmp_path / "answers.png"
    journal = ["--journal", str(tmp_path / "rig.jsonl")]
    process = started("--seconds", "0.3", *journal, "--save", url, "--histogram", str(picture))
    said = process.communicate(timeout=PATIENCE_SECONDS)[0]
    with reopened(rig, tmp_path / "rig.jsonl") as after, Reader.open(url) as reader:
        [config] = reader.configs()
        assert np.array_equal(reader.curves(config.config_key).values, [after.errors])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "answers: " in said


def test_a_motor_that_never_comes_and_a_database_that_fails_do_not_hold_it(
    rig: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rig, "PATIENCE", 0.1)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
        Explorer(rig.MOTOR, steps=50) as explorer,
    ):
        wire.bind(("127.0.0.1", 0))
        assert len(rig.explore(wire, explorer, seconds=600.0)) == 0
        rig.save(explorer, "sqlite:////dev/null/results.db")
    assert "/dev/null/results.db" in capsys.readouterr().err
