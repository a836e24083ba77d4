"""Every field of every registered choice refuses what it cannot use, in one sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.errors import SpecificationError
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.registry import build
from dopt.systems import SYSTEMS

REGISTRIES: dict[str, dict[str, type[Any]]] = {
    "env": SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
}
POSITIVE = {
    *("gamma", "dt", "horizon", "grid_half_widths", "grid_points", "state_limit"),
    *("mass", "length", "cart_mass", "pole_mass", "mass_1", "mass_2", "length_1", "length_2"),
    *("inertia", "half_span", "width", "depth", "learning_rate", "window", "epsilon"),
    *("ensemble", "lookahead", "candidates", "starts", "n_features", "lengthscale", "amplitude"),
    *("regularization", "sketch_size", "hold", "iterations", "frequency", "band"),
    *("subspace", "count", "radius", "stride", "plans", "elites", "samples"),
    *(
        "n_links",
        "n_pendulums",
        "time_constant",
        "capacity",
        "refit_every",
        "replan_every",
        "members",
        "refresh_every",
        "batch",
        "steps",
        "noise_variance",
        "forgetting",
        "dry_rate",
        "motor_gain",
        "measurement_noise",
        "velocity_cutoff",
        *("front", "rear", "slip_speed", "motor", "steering", "steering_time", "amplitude"),
        *("inertia_z", "propeller_torque", "slow_speed", "slow_rate"),
        "core",
        "period",
        *("warm_up", "updates", "units", "fit_updates", "actors", "episodes", "entropy_weight"),
    ),
}
NONNEGATIVE = {
    *("noise", "gain", "gravity", "friction", "pivot_friction", "cart_friction", "drag"),
    *("beta_1", "beta_2", "stiffness", "damping", "budget_us", "final_friction", "underweighting"),
    "weight",
    *(
        "dry_friction",
        "coupling",
        "strength",
        "orbit",
        "spread",
        "front_grip",
        "rear_grip",
        "turn_drag",
    ),
    "measured_states",
    "discount",
}
FRACTIONS = {"beta_1", "beta_2", "discount"}
SHARES = {"forgetting", "band"}
TEXTS = {"form", "criterion", "states", "information", "domain", "integrator"}
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


def test_a_negative_mass_is_a_sentence() -> None:
    with pytest.raises(SpecificationError) as caught:
        build("env", SYSTEMS, {"name": "pendulum", "mass": -1})
    assert str(caught.value) == (
        "env.mass is -1.0 kg, but it has to be finite and above 0: "
        "set env.mass to a positive number."
    )


@pytest.mark.parametrize(
    ("section", "name", "field", "value", "words"),
    [
        ("learner", "ekf", "forgetting", 1.5, "above 0 and at most 1"),
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


def test_a_name_like_none_is_answered_with_all() -> None:
    with pytest.raises(SpecificationError, match=r": choose one of arm, car, cartpole, .*\.$"):
        build("env", SYSTEMS, {"name": "zzzz"})


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
