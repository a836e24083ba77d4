"""Systems and policies of a user's own, named by the path of their class."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from dopt.control.task import GOAL_FIELDS
from dopt.declare.registry import source_digest
from dopt.errors import SpecificationError
from dopt.policies.base import ClosedLoop
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.paths import EXAMPLE


@dataclass(frozen=True, kw_only=True)
class Nameless(ClosedLoop):
    pass


@dataclass(frozen=True, kw_only=True)
class Closed(ClosedLoop):
    name = "closed"


@dataclass(frozen=True, kw_only=True)
class Thief(ClosedLoop):
    name = "random"


@pytest.fixture(autouse=True)
def on_the_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    for name in ("vehicle", "batch_gauss_newton"):
        sys.modules.pop(name, None)


def specification(
    env: dict[str, object] | None = None, policy: dict[str, object] | None = None
) -> TrialSpec:
    return TrialSpec.from_mapping(
        {
            "env": env or {"_target_": "vehicle.Boat", "horizon": 20},
            "policy": policy or {"_target_": "vehicle.Staircase"},
            "model": {"name": "mlp"},
            "learner": {"name": "adam_window"},
        }
    )


def test_a_system_and_a_policy_of_ones_own_run_and_are_stored_by_name() -> None:
    spec = specification()
    result = run_trial(spec)
    assert (spec.columns()["env"], spec.columns()["policy"]) == ("boat", "staircase")
    assert result.diverged_at is None
    assert np.abs(result.inputs).max() <= spec.system.gamma


@pytest.mark.parametrize("policy", ["d_optimal", "uniform"])
def test_the_kernel_agrees_with_the_reference_on_it(policy: str) -> None:
    spec = specification(policy={"name": policy})
    fast, plain = run_trial(spec), run_trial(spec, path="reference")
    np.testing.assert_allclose(fast.states, plain.states, rtol=1e-6, atol=1e-9)


def test_the_mapping_leads_back_to_the_trial() -> None:
    spec = specification()
    again = TrialSpec.from_mapping(spec.to_mapping())
    assert again.trial_key == spec.trial_key
    assert spec.to_mapping()["env"]["_target_"] == "vehicle.Boat"  # type: ignore[index]


def test_another_state_of_the_file_is_another_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = specification()
    text = (EXAMPLE / "vehicle.py").read_text()
    (tmp_path / "vehicle.py").write_text(text + "\n# changed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("vehicle")
    after = specification()
    assert after.trial_key != before.trial_key
    with pytest.raises(SpecificationError, match="another state of its file"):
        TrialSpec.from_mapping(before.to_mapping())


def test_what_is_shipped_has_no_digest() -> None:
    spec = specification({"name": "pendulum"}, {"name": "random"})
    assert "_target_" not in spec.canonical_json()
    assert "source" not in spec.canonical_json()


def test_a_digest_is_that_of_the_file() -> None:
    assert source_digest(Closed) == source_digest(Thief)


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        ("nowhere.Boat", "cannot be imported"),
        ("vehicle.Bota", "cannot be imported"),
        ("Boat", "cannot be imported"),
        ("vehicle.np", "a dataclass derived from dopt's System"),
        ("vehicle.Staircase", "a dataclass derived from dopt's System"),
        ("dopt.systems.base.System", "a class that defines accelerations, known"),
    ],
)
def test_a_wrong_system_is_refused_in_a_sentence(path: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        specification({"_target_": path})
    assert "env._target_" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x = 1\ny = x / 0\n", r"fails in line 2 \(ZeroDivisionError: division by zero\)"),
        ("def f(:\n", r"fails in line 1 \(SyntaxError: invalid syntax\)"),
        ("import nowhere_else\n", r"fails in line 1 \(ModuleNotFoundError: .*nowhere_else'"),
    ],
)
def test_a_file_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, sentence: str
) -> None:
    file = tmp_path / "failing.py"
    file.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    expected = rf"^env\._target_ is 'failing\.Boat', but the file {file} {sentence}"
    with pytest.raises(SpecificationError, match=expected):
        specification({"_target_": "failing.Boat"})


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Nameless", "a class with a 'name' of its own"),
        ("Thief", "a class with a 'name' of its own"),
        ("Closed", "derive it from OpenLoop or CustomPolicy"),
    ],
)
def test_a_wrong_policy_is_refused_in_a_sentence(name: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        specification(policy={"_target_": f"{__name__}.{name}"})


def test_a_name_that_is_not_the_classs_is_refused() -> None:
    with pytest.raises(SpecificationError, match="is called 'boat'"):
        specification({"_target_": "vehicle.Boat", "name": "ship"})


def test_unknown_fields_are_named() -> None:
    with pytest.raises(SpecificationError, match=r"env\.boat field"):
        specification({"_target_": "vehicle.Boat", "mas": 3.0})


def option(group: str, name: str) -> dict[str, object]:
    """Return what an option of the tutorial sets."""
    content = OmegaConf.to_container(OmegaConf.load(EXAMPLE / f"conf/{group}/{name}.yaml"))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def test_a_learner_of_ones_own_learns() -> None:
    mapping = specification(policy={"name": "random"}).to_mapping()
    del mapping["path"]
    env = {**option("env", "boat"), "horizon": 100}
    learner = option("learner", "batch_gauss_newton")
    spec = TrialSpec.from_mapping({**mapping, "env": env, "learner": learner})
    assert spec.columns()["learner"] == "batch_gauss_newton"
    loss = run_trial(spec).loss
    assert loss[-1] < 0.7 * loss[0]
    np.testing.assert_array_equal(run_trial(spec).loss, loss)


def test_a_control_task_for_a_system_of_ones_own_can_be_solved() -> None:
    """Its nine keys are those that a system without a task of its own has to be given."""
    mapping = specification(option("env", "boat"), {"name": "random"}).to_mapping()
    task = option("task", "harbour")
    spec = TrialSpec.from_mapping({**mapping, "task": task})
    assert set(GOAL_FIELDS) < set(task)
    rows = {(row.t, row.measure): row.value for row in run_trial(spec).assessments}
    assert rows[0, "true_model_success"] == 1
    assert rows[200, "free_run_error"] < 0.5 * rows[0, "free_run_error"]
    assert rows[200, "coverage"] > rows[50, "coverage"] > 0
