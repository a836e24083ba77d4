"""Fields of registered choices: refused values, annotations, added fields, own classes."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Optional, Union

import pytest

from dopt.control.task import Control
from dopt.errors import SpecificationError
from dopt.fields import Validated, parameter
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.policies.base import CompiledPolicy
from dopt.registry import added_defaults, build, identifying_section, section_of
from dopt.spec.config import completed
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum
from tests.dopt.trials import trial

REGISTRIES: dict[str, dict[str, type[Any]]] = {
    "env": SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
}
NONNEGATIVE_NAMES = """
weight measured_states discount noise gain gravity friction pivot_friction cart_friction drag
beta_1 beta_2 stiffness damping budget_us final_friction underweighting dry_friction coupling
strength orbit spread front_grip rear_grip turn_drag refit_every
"""
NONNEGATIVE = set(NONNEGATIVE_NAMES.split())
"""Fields that may be 0: every other number has to be positive, a new one too."""

OF_ANY_SIZE = {"goal", "initial"}
FREE = {"initial_state", "output_matrix"} | OF_ANY_SIZE
FRACTIONS = {"beta_1", "beta_2", "discount"}
SHARES = {"forgetting", "band"}
TEXTS = {"hyperparameters", "form", "criterion", "states", "information", "domain"}
TEXTS |= {"integrator", "overshoot"}
LISTED_TEXTS = {"unknown"}
NOT_NUMBERS: tuple[Any, ...] = ("abc", True, {"a": 1}, float("nan"), float("inf"), 10**400)


def fields_of(section: str) -> Iterator[tuple[type[Any], dataclasses.Field[Any]]]:
    for cls in REGISTRIES[section].values():
        for field in dataclasses.fields(cls):
            yield cls, field


def bad_values(field: dataclasses.Field[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield values that a field has to refuse, each with the number that the sentence names."""
    if field.name in TEXTS:
        yield from ((value, value) for value in ("abc", 1, True, None, ["primal"]))
        return
    if field.name in LISTED_TEXTS:
        yield from ((value, value) for value in ("abc", 1, True, None, [1]))
        return
    numbers = list(NOT_NUMBERS)
    numbers += [-1] if field.name not in FREE else []
    numbers += [0] if field.name not in FREE | NONNEGATIVE else []
    numbers += [1] if field.name in FRACTIONS else []
    numbers += [1.5] if field.name in SHARES else []
    numbers += [0.5, "3", 2**31] if "int" in str(field.type) else []
    if not str(field.type).startswith("tuple"):
        yield from ((number, number) for number in numbers)
        yield [1.0], [1.0]
        return
    rest = field.default[1:]
    yield from (((number, *rest), number) for number in numbers)
    if not field.default:  # of any size, which another field decides
        return
    for value in (3.0,) if field.name in OF_ANY_SIZE else (3.0, rest, (*field.default, 1)):
        yield value, None


@pytest.mark.parametrize("section", REGISTRIES)
def test_bad_values_are_refused_by_path_and_value(section: str) -> None:
    for cls, field in fields_of(section):
        for value, named in bad_values(field):
            with pytest.raises(SpecificationError) as caught:
                build(section, REGISTRIES[section], {"name": cls.name, field.name: value})
            message = str(caught.value)
            assert f"{section}.{field.name}" in message
            assert any(
                words in message
                for words in (" expected", " has to be ", " needs ", " valid ", "hoose one of ")
            )
            assert message.endswith(".")
            assert "\n" not in message
            if isinstance(named, str | bool):
                assert repr(named) in message
            elif isinstance(named, int | float) and abs(named) <= 1:
                assert str(named) in message


@pytest.mark.parametrize("section", REGISTRIES)
def test_the_default_is_accepted_as_a_list_or_a_tuple(section: str) -> None:
    for cls, field in fields_of(section):
        default = field.default
        as_list = list(default) if isinstance(default, tuple) else default
        item = build(section, REGISTRIES[section], {"name": cls.name, field.name: as_list})
        assert item == cls()
        assert hash(item) == hash(cls())
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(item, field.name, 1)


@pytest.mark.parametrize(
    ("section", "given_section", "sentence"),
    [
        ("policy", {"name": "Periodic"}, "policy 'Periodic'.*did you mean 'periodic'"),
        ("model", {"name": "mpl"}, "model 'mpl'.*did you mean 'mlp'.*gaussian_process.*rff"),
        ("env", {"name": "pendulum", "lenght": 2}, "'lenght' is unknown.*did you mean 'length'"),
        ("model", {}, r"model\.name is missing"),
        ("learner", {"name": "joint_ekf", "refit_every": 0}, "it has to be from 1 to 2147483647"),
    ],
)
def test_a_wrong_section_is_refused_and_an_unknown_name_answered_with_the_nearest(
    section: str, given_section: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        build(section, REGISTRIES[section], given_section)


@dataclass(frozen=True, kw_only=True)
class Typed(Validated):
    section: ClassVar[str] = "policy"

    count: int = parameter(3, bound="positive")
    share: float = 0.5
    mode: str = parameter("fast", choices=("fast", "slow"))
    sizes: tuple[int, ...] = (1, 2)
    words: tuple[str, ...] = ()
    pair: tuple[float, float] = parameter((0.0, 1.0), size=2)
    limit: float | None = None
    start: Optional[int] = None  # noqa: UP045  # the older form of the same
    either: Union[int, float] = 1  # noqa: UP007


def test_a_value_keeps_the_type_of_its_field() -> None:
    given: dict[str, Any] = {"count": 4, "share": 1, "mode": "slow", "sizes": [5], "words": ["a"]}
    item = Typed(**given, pair=[1, 2], start=7)  # type: ignore[arg-type]  # a list
    expected = "count=4, share=1.0, mode='slow', sizes=(5,), words=('a',), pair=(1.0, 2.0)"
    assert repr(item) == f"Typed({expected}, limit=None, start=7, either=1.0)"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"count": 0}, "policy.count is 0, but it has to be from 1 to 2147483647"),
        ({"count": None}, "policy.count is null, but a whole number is expected"),
        ({"share": "half"}, "policy.share is 'half' (str), but a number is expected"),
        ({"mode": 1}, "policy.mode is 1 (int), but a text is expected"),
        ({"mode": "fats"}, "fast"),
        ({"sizes": (1.5,)}, "policy.sizes[0] is 1.5 (float), but a whole number is expected"),
        ({"words": (1,)}, "policy.words[0] is 1 (int), but a text is expected"),
        ({"pair": (1.0,)}, "but a list of 2 numbers is expected"),
    ],
)
def test_another_type_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecificationError) as caught:
        Typed(**given)
    assert words in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class Held(Validated):
    section: ClassVar[str] = "policy"

    table: dict[str, float] = parameter(None)  # noqa: RUF009  # immutable


@dataclass(frozen=True, kw_only=True)
class Misspelt(Validated):
    section: ClassVar[str] = "policy"

    count: itn = 3  # type: ignore[name-defined]  # noqa: F821


@pytest.mark.parametrize(
    ("cls", "shown"), [(Held, "annotated as dict[str, float]"), (Misspelt, "annotated as itn")]
)
def test_an_annotation_of_another_type_is_refused(cls: type[Validated], shown: str) -> None:
    with pytest.raises(SpecificationError, match="change the annotation") as caught:
        cls()
    assert shown in str(caught.value)
    assert cls.__name__ in str(caught.value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Base(CompiledPolicy):
    gain: float = 0.5
    frequency: float | None = None
    label: str | None = None
    delay: int = parameter(3, "steps", "positive", added=True)
    bounds: tuple[float, ...] = parameter((0.0, 1.0), size=2, added=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Derived(Base):
    name: ClassVar[str] = "derived"

    share: float = 0.25

    @staticmethod
    def plan(trial: Any, t: int, u: Any) -> None:
        """Do nothing."""


def test_a_section_has_every_field_and_what_identifies_it_only_what_was_changed() -> None:
    item = Derived(delay=4)
    assert section_of(Derived())["delay"] == 3
    assert section_of(Derived())["bounds"] == [0.0, 1.0]
    assert not {"delay", "bounds"} & identifying_section(Derived()).keys()
    assert identifying_section(item)["delay"] == 4
    assert "bounds" not in identifying_section(item)
    assert added_defaults(Derived) == {"delay": 3, "bounds": [0.0, 1.0]}
    gain, frequency, share = item.kernel_numbers(1, 1.0)  # without added fields and texts
    assert (gain, share) == (0.5, 0.25)
    assert math.isnan(frequency), "a number that is not given keeps its place"
    assert Derived(frequency=2.0, label="slow").kernel_numbers(1, 1.0) == (0.5, 2.0, 0.25)


PLAIN = trial("pendulum", "d_optimal")
FRESH = trial("pendulum", "d_optimal", policy={"information": "fresh"})


def test_a_stored_configuration_is_completed() -> None:
    stored = json.loads(PLAIN.config_json)
    assert "information" not in stored["policy"]
    whole = completed(stored)
    assert whole == PLAIN.config.content()
    assert whole["policy"]["information"] == "accumulated"  # type: ignore[index]
    assert completed(json.loads(FRESH.config_json)) == FRESH.config.content()
    assert completed(whole) == whole
    other = {"policy": {"name": "own", "_target_": "nowhere.Own", "source": "0"}, "env": "pendulum"}
    assert completed(other) == other, "a class that is not loaded"
    assert "information" not in completed(json.loads(trial("arm", "random").config_json))["policy"]  # type: ignore[operator]


def test_a_section_of_a_users_class_is_completed_where_it_is_loaded() -> None:
    given = {"name": "derived", "_target_": f"{__name__}.Derived"}
    mapping = trial("arm", "random").to_mapping() | {"policy": given}
    spec = TrialSpec.from_mapping(mapping)
    stored = json.loads(spec.config_json)
    assert "delay" not in stored["policy"]
    assert completed(stored)["policy"]["delay"] == 3  # type: ignore[index]


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
        (Sampled, "class Sampled declares samples"),
        (Untyped, "class Untyped sets mass without a type"),
    ],
)
def test_values_that_a_base_class_hides_are_refused(cls: type[Validated], sentence: str) -> None:
    """What is no field needs no dataclass."""
    assert Renamed().mass == Pendulum().mass
    with pytest.raises(SpecificationError, match=sentence):
        cls()
    if cls is Damped:  # before its fields are unknown
        with pytest.raises(SpecificationError, match=sentence):
            TrialSpec.from_names({"_target_": f"{__name__}.Damped", "drag": 1.0}, "random")
