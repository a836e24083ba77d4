"""Classes that say that they are compiled, but that the kernel does not know: none runs another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from dopt.algorithm import Score, switch_step
from dopt.errors import SpecificationError
from dopt.kernel.from_spec import network_of
from dopt.kernel.pointers import function_of
from dopt.learning.base import Learner
from dopt.models import Model
from dopt.policies import POLICIES, Search
from dopt.policies.base import ClosedLoop
from dopt.policies.search import SCORES, score_code
from dopt.systems import SYSTEMS


@dataclass(frozen=True, kw_only=True)
class NewPolicy(ClosedLoop):
    name: ClassVar[str] = "new"
    compiled: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class NewLearner(Learner):
    name: ClassVar[str] = "new"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.adam.forgotten"


@dataclass(frozen=True, kw_only=True)
class NewModel(Model):
    name: ClassVar[str] = "new"
    compiled: ClassVar[bool] = True

    def n_parameters(self, system: object) -> int:  # noqa: ARG002
        return 1

    def initial_parameters(self, system: object, rng: object) -> np.ndarray:  # noqa: ARG002
        return np.zeros(1)

    def predict_at(self, system: object, parameters: object, points: np.ndarray) -> np.ndarray:  # noqa: ARG002
        return points


@dataclass(frozen=True, kw_only=True)
class NewSearch(Search):
    name: ClassVar[str] = "new"

    @property
    def score(self) -> str:
        return "juint"


@pytest.mark.parametrize("part", [NewPolicy(), NewLearner()])
def test_a_kernel_function_that_does_not_exist_is_named(part: ClosedLoop | Learner) -> None:
    with pytest.raises(SpecificationError, match="'new' names the kernel function"):
        function_of(part, None)


def test_a_model_that_the_kernel_does_not_know_is_refused() -> None:
    with pytest.raises(SpecificationError, match="model 'new' says that it is compiled"):
        network_of(SYSTEMS["pendulum"](), NewModel())


def test_an_unknown_score_is_refused() -> None:
    with pytest.raises(SpecificationError, match=r"score of policy 'new'.*joint"):
        score_code(NewSearch())


def test_every_score_has_a_name_and_each_policy_that_searches_one_of_them() -> None:
    assert list(SCORES.values()) == list(Score)
    searching = [cls() for cls in POLICIES.values() if issubclass(cls, Search)]
    assert {score_code(policy) for policy in searching} >= set(Score) - {Score.JOINT}


@pytest.mark.parametrize(("steps", "switch"), [(1, 1), (2, 1), (5, 2), (6, 3)])
def test_plans_switch_half_way(steps: int, switch: int) -> None:
    assert switch_step(steps) == switch
