"""A plan or an update of a user's own that is none is refused in a sentence, on both paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.learning.base import CustomLearner, Updater
from dopt.policies.base import Array, CustomPolicy, Planner
from dopt.run import Path, run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import System
from dopt.trial_view import TrialView

PATHS = pytest.mark.parametrize("path", ["kernel", "reference"])


class Answering(Planner):
    """A plan whose inputs a function gives."""

    def __init__(self, answer: Callable[[TrialView], Any]) -> None:
        self._answer = answer

    def choose(self, view: TrialView) -> Array:
        answer: Array = self._answer(view)
        return answer


class Unwatching:
    def choose(self, view: TrialView) -> Array:
        return view.inputs[-1]


class Silent(Updater):
    def update(self, view: TrialView) -> Array:  # noqa: ARG002
        return None  # type: ignore[return-value]  # the mistake


GIVEN: dict[str, Any] = {
    "none": None,
    "text": "x",
    "class": Answering,
    "unwatching": Unwatching(),
    "silent": Silent(),
    "no input": Answering(lambda _: None),
    "word": Answering(lambda _: "left"),
    "complex": Answering(lambda _: np.array([1j])),
    "ragged": Answering(lambda _: [[1.0], 2.0]),
    "nan": Answering(lambda _: np.array([np.nan])),
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


def own(name: str, what: str) -> dict[str, object]:
    return {"_target_": f"{__name__}.{name}", "what": what}


def refused(policy: Any, learner: Any, path: Path, sentence: str) -> None:
    env = {"name": "pendulum", "horizon": 5, "grid_points": [4, 4]}
    spec = TrialSpec.from_names(env, policy, learner=learner)
    with pytest.raises(SpecificationError, match=sentence) as caught:
        run_trial(spec, path)
    assert "\n" not in str(caught.value)


@PATHS
@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("none", r"^planner\(\) of policy 'bringing' returned None, .*base\.Planner .* add the r"),
        ("text", r"returned an object of type str, .* return one that has choose, observe"),
        ("class", r"returned the class Answering itself, .* return Answering\(\.\.\.\)"),
        ("unwatching", r"returned an object of type Unwatching, .* one that has observe, feedback"),
    ],
)
def test_what_is_no_planner_is_refused(what: str, sentence: str, path: Path) -> None:
    refused(own("Bringing", what), "adam", path, sentence)


@PATHS
@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("none", r"^updater\(\) of learner 'teaching' returned None, .*base\.Updater .* add the r"),
        ("text", r"returned an object of type str, .* return one that has update"),
        ("silent", r"^learner 'teaching' returned None, but parameters of shape .* its update\(\)"),
    ],
)
def test_what_is_no_updater_is_refused(what: str, sentence: str, path: Path) -> None:
    refused("random", own("Teaching", what), path, sentence)


@PATHS
@pytest.mark.parametrize(
    ("what", "shown"),
    [
        ("no input", "None"),
        ("word", "'left'"),
        ("complex", r"array\(\[0\.\+1\.j\]\)"),
        ("ragged", r"\[\[1\.0\], 2\.0\]"),
        ("nan", r"array\(\[nan\]\)"),
    ],
)
def test_an_input_that_is_no_finite_numbers_is_refused(what: str, shown: str, path: Path) -> None:
    sentence = rf"of policy 'bringing' returned {shown} at step 1, .* \(1,\), .* its choose\(\)"
    refused(own("Bringing", what), "adam", path, sentence)
