"""Compiled policies and learners of a user's own: examples, copies of shipped ones, bad ones."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.learning import Adam
from dopt.learning.base import CompiledLearner
from dopt.policies import DOptimal
from dopt.policies.base import CompiledPolicy, CustomPolicy, Planner
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import System
from dopt.trial_view import TrialView
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial
from tests.paths import EXAMPLE, ROOT
from tests.typed_commands import empty_folder, run_typed


@dataclass(frozen=True, kw_only=True)
class Large(CompiledPolicy):
    name: ClassVar[str] = "large"

    factor: float = 2.0

    @staticmethod
    def plan(trial: Any, t: int, u: np.ndarray) -> None:  # noqa: ARG004
        u[:] = trial.algorithm.policy[0] * trial.plant.gamma


@dataclass(frozen=True, kw_only=True)
class Drawn(CompiledPolicy, CustomPolicy):
    """A random direction at each step."""

    name: ClassVar[str] = "drawn"
    compiled: ClassVar[bool] = True

    @staticmethod
    def plan(trial: Any, t: int, u: np.ndarray) -> None:
        u[:] = trial.plant.gamma * trial.randomness.ties[t]

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return Directions()


class Directions(Planner):
    def choose(self, view: TrialView) -> np.ndarray:
        return view.system.gamma * view.tie


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


def own(name: str, **fields: object) -> dict[str, object]:
    return {"_target_": f"{__name__}.{name}", **fields}


def changed(
    section: str, given: dict[str, object], env: str = "pendulum", **more: Any
) -> TrialSpec:
    mapping = trial(env, "random", 1, env={"horizon": 12}, learner={"name": "adam"}).to_mapping()
    return TrialSpec.from_mapping({**mapping, section: given, **more})


@pytest.mark.parametrize("env", ["pendulum", "arm"])
@pytest.mark.parametrize(
    ("section", "target"), [("policy", "frontier.Frontier"), ("learner", "heavy_ball.HeavyBall")]
)
def test_the_examples_of_the_tutorial_mean_the_same_on_both_paths(
    env: str, section: str, target: str
) -> None:
    spec = changed(section, {"_target_": target}, env)
    assert spec.config.path == "kernel"
    fast, plain = run_trial(spec), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-8
    assert relative_gap(fast.parameters, plain.parameters) < 1e-8


def test_copies_of_shipped_classes_give_their_very_numbers() -> None:
    shipped = trial("cartpole", "d_optimal", 2, env={"horizon": 120})
    for section, name in (("policy", "OwnDOptimal"), ("learner", "OwnAdam")):
        given = {"_target_": f"studies.speed.compiled_plugins.{name}"}
        copy = run_trial(TrialSpec.from_mapping({**shipped.to_mapping(), section: given}))
        assert np.array_equal(copy.inputs, run_trial(shipped).inputs)
        assert np.array_equal(copy.parameters, run_trial(shipped).parameters)


def test_the_file_is_part_of_the_key() -> None:
    section = changed("policy", own("Large")).to_mapping()["policy"]
    assert isinstance(section, dict)
    assert len(str(section["source"])) == 16


def test_a_learner_keeps_its_memory() -> None:
    assert run_trial(changed("learner", own("Counting"))).parameters[0] == 12.0


def test_an_input_that_is_too_large_is_refused() -> None:
    spec = changed("policy", own("Large"))
    with pytest.raises(SpecificationError, match=r"'large' chose an input of norm .* at step 1"):
        run_trial(spec)
    run_trial(changed("policy", own("Large", factor=1.0)))


def test_both_paths_have_the_same_random_directions() -> None:
    spec = changed("policy", own("Drawn"), "arm")
    fast, plain = run_trial(spec), run_trial(spec, "reference")
    assert np.array_equal(fast.inputs, plain.inputs)
    assert len(np.unique(fast.inputs, axis=0)) == 12


def test_a_function_that_does_not_compile_is_one_sentence() -> None:
    with pytest.raises(SpecificationError, match="of learner 'broken' does not compile") as e:
        run_trial(changed("learner", own("Broken")))
    assert len(str(e.value).splitlines()) == 1


def test_what_brings_a_compiled_function_alone_is_refused_on_the_reference_path() -> None:
    with pytest.raises(SpecificationError, match="'large' runs in the compiled kernel alone"):
        changed("policy", own("Large"), path="reference")


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
