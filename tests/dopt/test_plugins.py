"""Users' policies and learners, in numpy and compiled."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.learning import Adam
from dopt.learning.base import CompiledLearner, CustomLearner, Updater
from dopt.policies import DOptimal
from dopt.policies.base import CompiledPolicy, CustomPolicy, OpenLoop, Planner
from dopt.reference.batch import run_trials
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, System
from tests.dopt.custom_plugins import ANSWERS, Answer
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial
from tests.paths import EXAMPLE, ROOT, printed
from tests.typed_commands import empty_folder, run_typed

HERE = "tests.dopt.custom_plugins"


def specification(system: str = "pendulum", seed: int = 0, /, **sections: Any) -> TrialSpec:
    """Return a small trial; ``sections`` are whole ones in the place of the usual ones."""
    learner = {"name": "adam"}
    usual = trial(system, "d_optimal", seed, env={"horizon": 25}, learner=learner).to_mapping()
    return TrialSpec.from_mapping(usual | {"path": None} | sections)


def own(name: str, **fields: Any) -> dict[str, Any]:
    return {"_target_": f"{HERE}.{name}", **fields}


def here(name: str, **fields: Any) -> dict[str, Any]:
    return {"_target_": f"{__name__}.{name}", **fields}


PATHS = pytest.mark.parametrize("path", ["kernel", "reference"])


@PATHS
@pytest.mark.parametrize("parts", [{"policy": "Copy"}, {"learner": "Descent"}])
def test_numpy_repeats_algorithm_2_and_adam(path: str, parts: dict[str, str]) -> None:
    plain = run_trial(specification(**{part: own(name) for part, name in parts.items()}), path)
    shipped = run_trial(specification(), path)
    np.testing.assert_allclose(plain.inputs, shipped.inputs, atol=1e-12)
    np.testing.assert_allclose(plain.parameters, shipped.parameters, rtol=1e-9)
    assert (plain.plan_us[1:] > 0.0).all()
    assert (plain.learn_us > 0.0).all()


@pytest.mark.parametrize("env", [{"name": "pendulum"}, {"name": "arm", "integrator": "rk4"}])
def test_both_paths_answer_the_same(env: dict[str, Any]) -> None:
    spec = specification(policy=own("Asking"), env={**env, "horizon": 12})
    answered = []
    for path in ("kernel", "reference"):
        ANSWERS.clear()
        run_trial(spec, path)
        answered.append([dict(answers) for answers in ANSWERS])
    fast, plain = answered
    assert len(fast) == len(plain) == 11
    for one, other in zip(fast, plain, strict=True):
        for name, values in one.items():
            assert values.shape == other[name].shape, name
            np.testing.assert_allclose(values, other[name], rtol=1e-7, atol=1e-9, err_msg=name)


def test_limits_hold_for_a_plan_in_numpy() -> None:
    limits = {"bounds": {"u": [-0.5, 0.5]}}
    spec = specification(policy=own("Coin"), limits=limits)
    assert np.abs(run_trial(spec).inputs).max() == 0.5


def test_trials_in_lockstep_are_those_run_alone() -> None:
    specs = [specification("pendulum", seed, policy=own("Coin")) for seed in range(3)]
    together, alone = run_trials(specs), [run_trial(spec, "reference") for spec in specs]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one.states, other.states, rtol=1e-9)
    assert not np.array_equal(alone[0].inputs, alone[1].inputs)
    np.testing.assert_array_equal(alone[0].inputs, run_trial(specs[0]).inputs)


def answering(answer: object) -> SimpleNamespace:
    """Return a plan whose inputs are given."""
    return SimpleNamespace(choose=lambda _: answer, observe=print, feedback=print)


GIVEN: dict[str, Any] = {
    "none": None,
    "text": "x",
    "class": Planner,
    "unwatching": SimpleNamespace(choose=print),
    "deaf": SimpleNamespace(choose=lambda: None, observe=print, feedback=print, update=lambda: 0),
    "silent": SimpleNamespace(update=lambda _: None),
    "no input": answering(None),
    "word": answering("left"),
    "complex": answering(np.array([1j])),
    "ragged": answering([[1.0], 2.0]),
    "nan": answering(np.array([np.nan])),
    "two": answering(np.ones(2)),
    "large": answering(np.array([4.0])),
    "long": SimpleNamespace(update=lambda view: np.append(view.parameters, 0.0)),
    "flat": np.ones(5),
    "wide": np.ones((5, 4)),
    "far": np.full((5, 1), 1e3),
    "lost": np.full((5, 1), np.nan),
    "lost later": Answer(lambda view: np.full(1, np.nan) if view.t >= 5 else 0.0 * view.inputs[0]),
    "tampering": Answer(lambda view: np.negative(view.states[0, :1], out=view.states[0, :1])),
    "an input": Answer(lambda view: view.following(view.states[-1], np.zeros((1, 2)))),
    "an axis": Answer(lambda view: view.jacobian(view.states[-1:])),
}


@dataclass(frozen=True, kw_only=True)
class Bringing(CustomPolicy):
    name: ClassVar[str] = "bringing"
    what: str = "none"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        plan: Planner = GIVEN[self.what]
        return plan


@dataclass(frozen=True, kw_only=True)
class Teaching(CustomLearner):
    name: ClassVar[str] = "teaching"
    what: str = "none"

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        update: Updater = GIVEN[self.what]
        return update


@dataclass(frozen=True, kw_only=True)
class Drawing(OpenLoop):
    name: ClassVar[str] = "drawing"
    what: str = "flat"

    def inputs(self, system: System, rng: np.random.Generator) -> Any:  # noqa: ARG002
        return GIVEN[self.what]


INPUT = r"of policy 'bringing' returned {} at step 1, .* \(1,\), .* its choose\(\)"


@PATHS
@pytest.mark.parametrize(
    ("part", "what", "sentence"),
    [
        ("policy", "none", r"^planner\(\) of policy 'bringing' returned None, .*base\.Planner"),
        ("policy", "text", r"an object of type str, .* return one that has choose, observe"),
        ("policy", "class", r"returned the class Planner itself, .* return Planner\(\.\.\.\)"),
        (
            "policy",
            "unwatching",
            r"of type SimpleNamespace, .* return one that has observe, feedback",
        ),
        ("policy", "deaf", r"of type SimpleNamespace, .* return one that has choose\(view\)"),
        ("learner", "deaf", r"of type SimpleNamespace, .* return one that has update\(view\)"),
        ("learner", "none", r"^updater\(\) of learner 'teaching' returned None, .*base\.Updater"),
        ("learner", "text", r"returned an object of type str, .* return one that has update"),
        ("learner", "long", "^learner 'teaching' returned parameters of shape"),
        ("learner", "silent", r"^learner 'teaching' returned None, but parameters .* update\(\)"),
        ("policy", "no input", INPUT.format("None")),
        ("policy", "word", INPUT.format("'left'")),
        ("policy", "complex", INPUT.format(r"array\(\[0\.\+1\.j\]\)")),
        ("policy", "ragged", INPUT.format(r"\[\[1\.0\], 2\.0\]")),
        ("policy", "nan", INPUT.format(r"array\(\[nan\]\)")),
        ("policy", "two", r"an input of shape \(2,\) at step 1, but \(1,\) is expected"),
        ("policy", "large", "an input of norm 4 at step 1, but env.gamma is 2: scale it down"),
        ("inputs", "flat", r"of shape \(5,\) .* of shape \(5, 1\) are expected: correct its"),
        ("inputs", "wide", r"of shape \(5, 4\) .* of shape \(5, 1\) are expected"),
        ("inputs", "far", r"an input of norm 1000, but env\.gamma is 2: scale it down"),
        ("inputs", "lost", r"an input of norm nan, but env\.gamma is 2"),
    ],
)
def test_what_own_parts_return_is_checked(part: str, what: str, sentence: str, path: Any) -> None:
    own: Any = {"policy": Bringing, "learner": Teaching, "inputs": Drawing}[part](what=what)
    system = SYSTEMS["pendulum"](horizon=5, grid_points=(4, 4))
    spec = TrialSpec.of_system(system, **({"policy": "random"} | {own.section: own}))
    with pytest.raises(SpecificationError, match=sentence) as caught:
        run_trial(spec, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("too_many", "error", "sentence"),
    [
        ("tampering", ValueError, "read-only"),
        ("an input", SpecificationError, r"inputs of shape \(1, 2\), but \(N"),
        ("an axis", SpecificationError, r"a state of shape \(1, 2\), but \(2,\) is expec"),
    ],
)
def test_a_plan_in_the_kernel_neither_writes_nor_reads_where_it_may_not(
    too_many: str, error: type[Exception], sentence: str
) -> None:
    """Compiled code would read beyond the end of an array."""
    with pytest.raises(error, match=sentence):
        run_trial(specification(policy=here("Bringing", what=too_many)))


@PATHS
def test_a_plan_that_gets_lost_with_its_model_ends_its_trial_alone(path: str) -> None:
    learner = {"name": "adam", "learning_rate": 1e40}
    result = run_trial(
        specification(policy=here("Bringing", what="lost later"), learner=learner), path
    )
    assert result.diverged_at == 5
    assert np.isfinite(result.loss[:5]).all()
    assert np.isnan(result.loss[5:]).all()


def test_torch_is_loaded_where_a_trial_needs_it_and_no_sooner() -> None:
    """The driver of a grid only makes the specification, and sends it to its workers."""
    plain = specification(policy=own("Coin"), learner=own("Descent")).to_mapping()
    in_torch = specification().to_mapping() | {"path": "reference"}
    program = (
        "import pickle, sys; from dopt.spec.trial import TrialSpec; "
        f"plain, in_torch = map(TrialSpec.from_mapping, ({plain!r}, {in_torch!r})); "
        "[pickle.dumps(spec) for spec in (plain, in_torch)]; in_torch.trial_key; "
        "from dopt.run import run_trial; run_trial(plain); assert 'torch' not in sys.modules; "
        "run_trial(in_torch); assert 'torch' in sys.modules; "
        "assert 'torch._dynamo' not in sys.modules"  # its compiler, which takes a second to load
    )
    printed(program)


@dataclass(frozen=True, kw_only=True)
class Large(CompiledPolicy):
    name: ClassVar[str] = "large"

    factor: float = 2.0

    @staticmethod
    def plan(trial: Any, t: int, u: np.ndarray) -> None:  # noqa: ARG004
        u[:] = trial.algorithm.policy[0] * trial.plant.gamma


@dataclass(frozen=True, kw_only=True)
class Broken(CompiledLearner):
    name: ClassVar[str] = "broken"

    @staticmethod
    def learn(trial: Any, t: int, target: np.ndarray) -> None:  # noqa: ARG004
        trial.state.no_such_field[0] = 0.0


@dataclass(frozen=True, kw_only=True)
class Counting(CompiledLearner):
    """Counts its steps in its memory and writes the count into the first parameter."""

    name: ClassVar[str] = "counting"

    @staticmethod
    def learn(trial: Any, t: int, target: np.ndarray) -> None:  # noqa: ARG004
        trial.state.learner_memory[1] += 1.0
        trial.state.theta[0] = trial.state.learner_memory[1]

    def memory_size(self, system: object, n_parameters: int) -> int:  # noqa: ARG002
        return 2


@dataclass(frozen=True, kw_only=True)
class Undeclared(DOptimal):
    """Changes an algorithm and does not say that the kernel knows the change."""

    name: ClassVar[str] = "undeclared"


@pytest.fixture(autouse=True)
def on_the_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    for name in ("frontier", "heavy_ball"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
@pytest.mark.parametrize(
    ("section", "target"), [("policy", "frontier.Frontier"), ("learner", "heavy_ball.HeavyBall")]
)
def test_the_examples_of_the_tutorial_mean_the_same_on_both_paths(
    env: str, section: str, target: str
) -> None:
    spec = specification(env, **{section: {"_target_": target}})
    assert spec.config.path == "kernel"
    fast, plain = run_trial(spec), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-8
    assert relative_gap(fast.parameters, plain.parameters) < 1e-8


COPIES = """
import numpy as np
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, System
from tests.dopt.trials import trial

small = {"env": {"horizon": 12}, "model": {"width": 4}, "learner": {"window": 5}}
shipped = trial("cartpole", "d_optimal", 2, **small)
expected = run_trial(shipped)
for section, name, fields in (("policy", "OwnDOptimal", {}), ("learner", "OwnAdam", {"window": 5})):
    given = {"_target_": f"studies.speed.compiled_plugins.{name}", **fields}
    copy = run_trial(TrialSpec.from_mapping({**shipped.to_mapping(), section: given}))
    assert np.array_equal(copy.inputs, expected.inputs), name
    assert np.array_equal(copy.parameters, expected.parameters), name
"""


def test_copies_of_shipped_classes_give_their_very_numbers() -> None:
    """In the interpreter, which takes a second: compiling the two takes twenty."""
    printed(COPIES, DOPT_PLAIN="1")


def test_a_learner_keeps_its_memory_and_its_file_is_part_of_the_key() -> None:
    spec = specification(learner=here("Counting"))
    assert run_trial(spec).parameters[0] == 25.0
    section: Any = spec.to_mapping()["learner"]
    assert len(section["source"]) == 16


@pytest.mark.parametrize(
    ("section", "name", "more", "sentence"),
    [
        ("policy", "Large", {}, r"'large' chose an input of norm .* at step 1"),
        ("learner", "Broken", {}, "of learner 'broken' does not compile"),
        ("policy", "Large", {"path": "reference"}, "'large' runs in the compiled kernel alone"),
    ],
)
def test_what_a_compiled_function_may_not_do_is_one_sentence(
    section: str, name: str, more: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        run_trial(specification(**{section: here(name)}, **more))
    assert "\n" not in str(caught.value)


def test_a_class_does_not_inherit_that_it_is_compiled() -> None:
    assert DOptimal.compiled
    assert not Undeclared.compiled
    assert not type("Slower", (Adam,), {"name": "slower"}).compiled


@pytest.mark.long
def test_the_commands_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    empty_folder(tmp_path, monkeypatch)
    page = (ROOT / "docs" / "compiled_plugins.md").read_text()
    lines = [line.strip() for line in page.splitlines() if line.startswith("    PYTHONPATH=")]
    assert len(lines) == 2
    for line in lines:
        run_typed(line, monkeypatch, capsys)
