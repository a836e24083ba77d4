"""A class that is no dataclass of its own cannot hide behind the values of its base class."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from dopt.control.task import Control
from dopt.errors import SpecificationError
from dopt.fields import Validated, parameter
from dopt.learning import Adam
from dopt.models import MLP
from dopt.policies.open_loop import RandomSphere
from dopt.spec.trial import TrialSpec
from dopt.systems import Pendulum


class Heavy(Pendulum):
    name: ClassVar[str] = "heavy"
    mass: float = parameter(5.0, "kg", "positive")


@dataclass(frozen=True, kw_only=True)
class Heavier(Heavy):
    name: ClassVar[str] = "heavier"


class Damped(Pendulum):
    name: ClassVar[str] = "damped"
    drag: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Untyped(Pendulum):
    name: ClassVar[str] = "untyped"
    mass = 5.0


class Quick(Adam):
    name: ClassVar[str] = "quick"
    learning_rate: float = 0.5


class Chance(RandomSphere):
    name: ClassVar[str] = "chance"
    share: float = 0.5


class Wide(MLP):
    width: int = 64


class Sampled(Control):
    samples: int = 3


class Renamed(Pendulum):
    """Changes what is no field, and keeps something for itself."""

    name: ClassVar[str] = "renamed"
    compiled: bool = False
    _kept: Any = None


@pytest.mark.parametrize(
    ("cls", "sentence"),
    [
        (Heavy, "class Heavy declares mass, but is no dataclass itself: put @dataclass"),
        (Heavier, "class Heavy declares mass"),
        (Damped, "class Damped declares drag"),
        (Quick, "class Quick declares learning_rate"),
        (Chance, "class Chance declares share"),
        (Wide, "class Wide declares width"),
        (Sampled, "class Sampled declares samples"),
        (Untyped, "class Untyped sets mass without a type"),
    ],
)
def test_values_that_a_base_class_hides_are_refused(cls: type[Validated], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        cls()


def test_a_section_of_such_a_class_is_refused_before_its_fields_are_unknown() -> None:
    with pytest.raises(SpecificationError, match="class Damped declares drag"):
        TrialSpec.from_names({"_target_": f"{__name__}.Damped", "drag": 1.0}, "random")


def test_what_is_no_field_needs_no_dataclass() -> None:
    assert Renamed().mass == Pendulum().mass
