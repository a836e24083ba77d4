"""Fields of registered choices: refused values, annotations, added fields, own classes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Optional, Union

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.control.task import Control
from dopt.errors import SpecificationError
from dopt.fields import Validated, parameter
from dopt.learning import LEARNERS, Adam
from dopt.models import MLP, MODELS
from dopt.policies import POLICIES
from dopt.policies.base import CompiledPolicy
from dopt.policies.open_loop import RandomSphere
from dopt.registry import added_defaults, build, identifying_section, section_of
from dopt.spec.config import completed, config_label, labels
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum
from tests.dopt.trials import trial

REGISTRIES: dict[str, dict[str, type[Any]]] = {
    "env": SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
}
POSITIVE_NAMES = """
gamma dt horizon grid_half_widths grid_points state_limit mass length cart_mass pole_mass mass_1
mass_2 length_1 length_2 inertia half_span width depth learning_rate window epsilon ensemble
lookahead candidates starts n_features lengthscale amplitude regularization sketch_size hold
iterations frequency band subspace count radius stride plans elites samples n_links n_pendulums
time_constant capacity replan_every members refresh_every batch steps noise_variance
forgetting dry_rate motor_gain measurement_noise velocity_cutoff core period front rear slip_speed
motor steering steering_time inertia_z propeller_torque slow_speed slow_rate warm_up updates units
fit_updates actors episodes entropy_weight first_rows growth
"""
POSITIVE = set(POSITIVE_NAMES.split())
NONNEGATIVE_NAMES = """
weight measured_states discount noise gain gravity friction pivot_friction cart_friction drag
beta_1 beta_2 stiffness damping budget_us final_friction underweighting dry_friction coupling
strength orbit spread front_grip rear_grip turn_drag refit_every
"""
NONNEGATIVE = set(NONNEGATIVE_NAMES.split())
FRACTIONS = {"beta_1", "beta_2", "discount"}
SHARES = {"forgetting", "band"}
TEXTS = {
    "hyperparameters",
    "form",
    "criterion",
    "states",
    "information",
    "domain",
    "integrator",
    "overshoot",
}
LISTED_TEXTS = {"unknown"}
OF_ANY_SIZE = {"goal", "initial"}
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
    numbers += [-1] if field.name in POSITIVE | NONNEGATIVE else []
    numbers += [0] if field.name in POSITIVE else []
    numbers += [1] if field.name in FRACTIONS else []
    numbers += [1.5] if field.name in SHARES else []
    numbers += [0.5, "3"] if "int" in str(field.type) else []
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


def test_every_field_has_a_bound_of_its_own() -> None:
    """A new field has to be put on one of the lists above, or be free on purpose."""
    names = {
        field.name
        for registry in REGISTRIES.values()
        for cls in registry.values()
        for field in dataclasses.fields(cls)
    }
    free = {"initial_state", "output_matrix"}
    assert names - POSITIVE - NONNEGATIVE == free | TEXTS | LISTED_TEXTS | OF_ANY_SIZE


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


@pytest.mark.parametrize(
    ("section", "name", "field", "value", "words"),
    [
        ("learner", "ekf", "forgetting", 1.5, "above 0 and at most 1"),
        ("learner", "joint_ekf", "refit_every", 0, "from 1 to 2147483647"),
        ("learner", "adam", "beta_1", 1.0, "at least 0 and below 1"),
        ("env", "pendulum", "noise", -1.0, "finite and at least 0"),
        ("env", "pendulum", "horizon", 0, "from 1 to 2147483647"),
        ("env", "pendulum", "horizon", 2**31, "from 1 to 2147483647"),
    ],
)
def test_a_bound_is_said_in_words(
    section: str, name: str, field: str, value: float, words: str
) -> None:
    with pytest.raises(SpecificationError, match=f", but it has to be {words}: set {section}"):
        build(section, REGISTRIES[section], {"name": name, field: value})


@pytest.mark.parametrize(
    ("section", "given_name", "nearest"),
    [
        ("env", "pendulun", "pendulum"),
        ("env", "cart_pole", "cartpole"),
        ("policy", "d-optimal", "d_optimal"),
        ("policy", "Periodic", "periodic"),
        ("model", "mpl", "mlp"),
        ("learner", "adamwindow", "adam_window"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(
    section: str, given_name: str, nearest: str
) -> None:
    with pytest.raises(SpecificationError) as caught:
        build(section, REGISTRIES[section], {"name": given_name})
    message = str(caught.value)
    assert f"{section} '{given_name}'" in message
    assert f"did you mean '{nearest}'?" in message
    assert all(name in message for name in REGISTRIES[section])


def test_an_unknown_field_is_answered_with_the_nearest() -> None:
    with pytest.raises(SpecificationError, match=r"'lenght' is unknown.*did you mean 'length'\?"):
        build("env", SYSTEMS, {"name": "pendulum", "lenght": 2})


@pytest.mark.parametrize("section", REGISTRIES)
def test_a_section_without_a_name_is_refused(section: str) -> None:
    with pytest.raises(SpecificationError, match=rf"{section}\.name is missing"):
        build(section, REGISTRIES[section], {})


@pytest.mark.parametrize("section", REGISTRIES)
def test_specifications_cannot_be_changed(section: str) -> None:
    for cls, field in fields_of(section):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(cls(), field.name, 1)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_exactly_the_positive_finite_numbers_are_lengths(value: float) -> None:
    accepted = 0.0 < value < float("inf")
    try:
        length = SYSTEMS["pendulum"](length=value).length
    except SpecificationError:
        assert not accepted
    else:
        assert accepted
        assert length == value


def test_whole_numbers_stay_whole_and_real_ones_become_floats() -> None:
    pendulum = SYSTEMS["pendulum"](mass=2, grid_points=[3, 4])
    assert isinstance(pendulum.mass, float)
    assert all(isinstance(number, int) for number in (*pendulum.grid_points, pendulum.horizon))


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


@dataclass(frozen=True, kw_only=True)
class Quoted(Validated):
    section: ClassVar[str] = "policy"

    count: int = parameter(3, bound="positive")  # immutable
    share: float = 0.5
    mode: str = parameter("fast", choices=("fast", "slow"))  # immutable
    sizes: tuple[int, ...] = (1, 2)
    words: tuple[str, ...] = ()
    pair: tuple[float, float] = parameter((0.0, 1.0), size=2)  # immutable
    limit: float | None = None
    start: int | None = None
    either: int | float = 1


FORMS = pytest.mark.parametrize("form", [Typed, Quoted])


@FORMS
def test_a_value_keeps_the_type_of_its_field(form: type[Any]) -> None:
    item = form(count=4, share=1, mode="slow", sizes=[5], words=["a"], pair=[1, 2], start=7)
    assert item.count == 4
    assert type(item.count) is int
    assert type(item.share) is float
    assert item.mode == "slow"
    assert item.sizes == (5,)
    assert type(item.sizes[0]) is int
    assert item.words == ("a",)
    assert [type(entry) for entry in item.pair] == [float, float]
    assert item.limit is None
    assert type(item.start) is int
    assert type(item.either) is float


@FORMS
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"count": 1.5}, "policy.count is 1.5 (float), but a whole number is expected"),
        ({"count": 0}, "policy.count is 0, but it has to be from 1 to 2147483647"),
        ({"count": None}, "policy.count is null, but a whole number is expected"),
        ({"share": "half"}, "policy.share is 'half' (str), but a number is expected"),
        ({"mode": 1}, "policy.mode is 1 (int), but a text is expected"),
        ({"mode": "fats"}, "fast"),
        ({"sizes": (1.5,)}, "policy.sizes[0] is 1.5 (float), but a whole number is expected"),
        ({"words": (1,)}, "policy.words[0] is 1 (int), but a text is expected"),
        ({"pair": (1.0,)}, "but a list of 2 numbers is expected"),
        ({"start": 1.5}, "policy.start is 1.5 (float), but a whole number is expected"),
    ],
)
def test_another_type_is_refused(form: type[Any], given: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecificationError) as caught:
        form(**given)
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


def test_added_fields_are_no_kernel_numbers() -> None:
    assert Derived(delay=4).kernel_numbers(1, 1.0) == (0.5, 0.25)


@pytest.mark.parametrize("name", sorted(POLICIES))
def test_what_identifies_a_section_builds_the_same_item(name: str) -> None:
    item = POLICIES[name]()
    assert build("policy", POLICIES, identifying_section(item)) == item
    assert build("policy", POLICIES, section_of(item)) == item


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
    assert "information" not in completed(json.loads(trial("arm", "random").config_json))["policy"]  # type: ignore[operator]


def test_a_class_that_is_not_loaded_is_left_as_it_is() -> None:
    section = {"name": "own", "_target_": "nowhere.Own", "source": "0"}
    assert completed({"policy": section, "env": "pendulum"}) == {
        "policy": section,
        "env": "pendulum",
    }


def test_a_section_of_a_users_class_is_completed_where_it_is_loaded() -> None:
    given = {"name": "derived", "_target_": f"{__name__}.Derived"}
    mapping = trial("arm", "random").to_mapping() | {"policy": given}
    spec = TrialSpec.from_mapping(mapping)
    stored = json.loads(spec.config_json)
    assert "delay" not in stored["policy"]
    assert completed(stored)["policy"]["delay"] == 3  # type: ignore[index]


def test_a_label_names_the_field_only_where_it_differs() -> None:
    old, new = json.loads(PLAIN.config_json), json.loads(FRESH.config_json)
    plain, fresh = config_label(old), config_label(new)
    assert "information" not in plain
    assert fresh == f"{plain}, information=fresh"
    assert labels([old, new]) == ["D-optimal", "information=fresh"]
    assert labels([completed(old), new]) == labels([old, new])


def test_the_text_that_is_stored_is_the_one_whose_hash_is_the_key(tmp_path: Path) -> None:
    from orchestrate.commands.maintenance import trial_key
    from orchestrate.store.maintenance import examine
    from tests.analysis.synthetic import fill

    for spec in (PLAIN, FRESH):
        assert trial_key(spec.config_json, spec.seed) == spec.trial_key
    url = f"sqlite:///{tmp_path}/results.db"
    fill(url, [PLAIN, FRESH])
    assert examine(url, trial_key) == []


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
