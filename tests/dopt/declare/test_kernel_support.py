"""Declarations for the kernel: places of the numbers, and the path of a trial that names none."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import pytest

from dopt.policies.base import CompiledPolicy
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chirping(CompiledPolicy):
    name: ClassVar[str] = "chirping"

    frequency: float | None = None
    label: str | None = None
    share: float = 0.5

    @staticmethod
    def plan(trial: Any, t: int, u: Any) -> None:
        """Do nothing."""


def test_a_number_keeps_its_place_where_one_before_it_is_not_given() -> None:
    frequency, share = Chirping().kernel_numbers(1, 1.0)
    assert math.isnan(frequency)
    assert share == 0.5
    assert Chirping(frequency=2.0, label="slow").kernel_numbers(1, 1.0) == (2.0, 0.5)


@pytest.mark.parametrize(
    ("model", "path"),
    [
        ({"name": "mlp"}, "kernel"),
        ({"_target_": "tests.dopt.custom_networks.Stack"}, "reference"),
    ],
)
def test_a_trial_without_a_path_is_on_the_one_that_knows_its_parts(
    model: dict[str, Any], path: str
) -> None:
    mapping = trial("pendulum", "d_optimal", 0).to_mapping() | {"model": model}
    assert TrialSpec.from_mapping({**mapping, "path": None}).config.path == path
