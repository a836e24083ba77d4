"""A system of a user's own that is none is refused in a sentence, before any trial."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from dopt.errors import SpecificationError
from dopt.spec.custom_system import check_system
from dopt.systems import SYSTEMS, Feature, Pendulum, System
from tests.dopt.trials import trial


def broken(**attributes: Any) -> System:
    """Return a pendulum of another class, with some of its attributes replaced."""
    functions = {
        name: staticmethod(value) if callable(value) else value
        for name, value in attributes.items()
    }
    made: Any = dataclass(frozen=True, kw_only=True)(type("Broken", (Pendulum,), functions))
    system: System = made()
    return system


def by_the_sign(state: Any, parameters: Any) -> tuple[Any, ...]:  # noqa: ARG001  # one signature
    return (1.0,) if state[1] > 0 else (-1.0,)


CASES: list[tuple[str, Any, str]] = [
    ("learned_rows", (5,), r"learned_rows of env 'pendulum' holds 5, but its 2 states .* 0 to 1"),
    ("learned_rows", (1, 1), r"learned_rows of env 'pendulum' are \(1, 1\), but no row twice"),
    ("features", (Feature("cos", 7),), r"features of env 'pendulum' holds 7"),
    ("features", (("cos", 0),), r"features of env 'pendulum' hold \('cos', 0\), .* Feature\('cos"),
    ("features", (Feature("tan", 0),), r"one of kind 'tan', but the kinds are identity, cos, sin"),
    ("phase_plane", (0, -1), r"phase_plane of env 'pendulum' holds -1"),
    (
        "accelerations",
        lambda state, *_: (state[0], state[1]),
        r"accelerations\(\) .* returns 2 numbers, but 1 are expected, one for each learned row",
    ),
    (
        "accelerations",
        lambda state, *_: -state[1],
        r"accelerations\(\) .* returns one number, but a tuple of 1 is .* return a, with its comma",
    ),
    ("known", lambda *_: 0.0, r"known\(\) .* returns one number, but a tuple of 2 is expected"),
    ("accelerations", lambda *_: None, r"accelerations\(\) .* fails .*TypeError"),
    (
        "accelerations",
        lambda state, *_: (math.sin(state[0]),),
        r"fails for arrays of 5 states .* the functions of dopt\.systems\.elementary",
    ),
    ("accelerations", by_the_sign, r"fails for arrays of 5 states \(ValueError"),
    (
        "known",
        lambda state, *_: (state[1],),
        r"known\(\) .* returns 1 numbers, but 2 are expected, one for each state: correct it",
    ),
    (
        "known",
        lambda state, inputs, *_: (state[1], inputs[0] ** 2),
        r"known\(\) of env 'pendulum' is not affine in the inputs",
    ),
    (
        "known",
        lambda state, inputs, *_: (state[1], abs(inputs[0])),
        r"known\(\) of env 'pendulum' is not affine in the inputs",
    ),
]


@pytest.mark.parametrize(("attribute", "value", "sentence"), CASES)
def test_what_is_no_system_is_refused(
    attribute: str, value: Callable[..., Any] | tuple[Any, ...], sentence: str
) -> None:
    system = broken(**{attribute: value})
    with pytest.raises(SpecificationError, match=sentence):
        dataclasses.replace(trial("pendulum", "random").config, system=system)


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_what_is_shipped_is_sound(name: str) -> None:
    check_system(SYSTEMS[name]())
