"""Arguments that are no specification and no system: the answer names the call that takes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dopt.errors import SpecificationError
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import Pendulum

CASES: list[tuple[Callable[..., Any], tuple[Any, ...], str]] = [
    (
        TrialSpec.from_names,
        (Pendulum(), "random"),
        r"key 'env' is a Pendulum, but a name or a section is .* to TrialSpec\.of_system",
    ),
    (TrialSpec.from_names, ("pendulum", 3), r"configuration key 'policy' is 3, but a section"),
    (TrialSpec.of_system, (Pendulum, "random"), r"is the class Pendulum, .* of it, Pendulum\(\)\."),
    (TrialSpec.of_system, ("pendulum", "random"), r"is 'pendulum', .* use TrialSpec\.from_names"),
    (TrialSpec.of_system, (Pendulum(), None), r"configuration key 'policy' is None, but a section"),
    (run_trial, ("pendulum",), r"run_trial was given 'pendulum', but a TrialSpec is expected"),
]


@pytest.mark.parametrize(("call", "arguments", "sentence"), CASES)
def test_another_kind_of_thing_is_refused_in_a_sentence(
    call: Callable[..., Any], arguments: tuple[Any, ...], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        call(*arguments)
