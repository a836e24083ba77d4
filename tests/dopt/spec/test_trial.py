from __future__ import annotations

import dataclasses
import json
import string
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.errors import IncompatibleError, SpecificationError
from dopt.spec.config import completed
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import ALL_PAIRS, covering, trial

SECTIONS = {"env": "system", "policy": "policy", "model": "model", "learner": "learner"}
OF_FRESH_ROWS = ("information", "refresh_every")
"""Fields that have one value where the model is linear in its parameters."""

OF_ONE_LEARNER = ("output_matrix",)
"""Fields that go with one learner: their part in the key is tested in test_output_matrix.py."""


def every_field(spec: TrialSpec) -> list[tuple[str, str, Any]]:
    """Return (section, field, another valid value) for every field of a trial."""
    return [
        (section, field.name, other(getattr(getattr(spec, attribute), field.name), field, spec))
        for section, attribute in SECTIONS.items()
        for field in dataclasses.fields(getattr(spec, attribute))
        if field.name not in OF_ONE_LEARNER
    ]


def other(value: Any, field: dataclasses.Field[Any], spec: TrialSpec) -> Any:
    if value is None:
        return 1 if "int" in str(field.type) else 1.5
    if isinstance(value, str):
        return next(choice for choice in field.metadata["choices"] if choice != value)
    if field.name.startswith("measure"):
        return tuple(range(spec.system.n_states))
    if value == ():
        return spec.system.initial_state
    if field.name == "grid_points":
        return [2 * value[0], *value[1:]]  # some have to be powers of two
    if isinstance(value, tuple):
        return [other(value[0], field, spec), *value[1:]]
    return 0.5 * value if 0 < value < 1 else value + 1


def with_value(spec: TrialSpec, section: str, field: str, value: Any) -> TrialSpec:
    mapping: dict[str, Any] = spec.to_mapping()
    needed: dict[str, Any] = {"information": "fresh"} if field == "refresh_every" else {}
    if field == "measured_states":
        needed = {"measurement_noise": [0.1] * len(value)}
    if field == "measurement_noise":
        needed, value = {"measured_states": value}, [0.2] * len(value)
    return TrialSpec.from_mapping(mapping | {section: mapping[section] | needed | {field: value}})


def test_every_trial_comes_back_from_its_mapping_and_its_json() -> None:
    for env, policy in ALL_PAIRS:
        spec = trial(env, policy, 7)
        again = TrialSpec.from_mapping(json.loads(json.dumps(spec.to_mapping())))
        assert again == spec
        assert again.trial_key == spec.trial_key
        assert again.canonical_json() == spec.canonical_json()


@pytest.mark.parametrize(("env", "policy"), covering(ALL_PAIRS))
def test_every_field_is_part_of_the_key(env: str, policy: str) -> None:
    spec = trial(env, policy)
    linear = spec.model.structure != "gradient"
    changes = [one for one in every_field(spec) if not (linear and one[1] in OF_FRESH_ROWS)]
    variants = [with_value(spec, *change) for change in changes]
    keys = [spec.config_key, *(variant.config_key for variant in variants)]
    assert len(set(keys)) == len(keys) > len(dataclasses.fields(spec.system))
    trial_keys = [spec.trial_key, *(variant.trial_key for variant in variants)]
    assert len(set(trial_keys)) == len(trial_keys)


def test_pairs_have_keys_of_their_own() -> None:
    specs = [trial(env, policy, seed) for env, policy in ALL_PAIRS for seed in range(3)]
    assert len({spec.trial_key for spec in specs}) == len(specs)
    assert len({spec.config_key for spec in specs}) == len(ALL_PAIRS)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))
def test_only_the_trial_key_depends_on_the_seed(first: int, second: int) -> None:
    one, two = trial("arm", "uniform", first), trial("arm", "uniform").with_seed(second)
    assert one.config_key == two.config_key
    assert one.config_json == two.config_json
    assert (one.trial_key == two.trial_key) == (first == second)


def test_keys_are_64_hexadecimal_digits() -> None:
    spec = trial("pendulum", "random")
    for key in (spec.trial_key, spec.config_key):
        assert len(key) == 64
        assert set(key) <= set(string.hexdigits.lower())


def test_the_key_does_not_depend_on_how_a_value_is_written() -> None:
    spec = trial("pendulum", "d_optimal", env={"mass": 1, "initial_state": [0, 0]})
    same: dict[str, Any] = {
        "seed": 0,
        "learner": {"name": "adam_window"},
        "model": {"depth": 2, "width": 16, "name": "mlp"},
        "policy": {"regularization": 0.001, "name": "d_optimal"},
        "env": {
            "initial_state": (0.0, -0.0),
            "grid_points": (4, 4),
            "mass": 1.0,
            "horizon": 30,
            "name": "pendulum",
        },
    }
    assert TrialSpec.from_mapping(same).trial_key == spec.trial_key


def test_canonical_json_is_sorted_compact_json_of_the_content() -> None:
    spec = trial("cartpole", "periodic", 5)
    content = json.loads(spec.canonical_json())
    assert content["seed"] == 5
    whole = completed(content)
    assert {key: whole[key] for key in spec.to_mapping()} == spec.to_mapping()
    written = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    assert spec.canonical_json() == written
    del content["seed"]
    assert json.loads(spec.config_json) == content


def test_columns_are_those_of_a_table_of_configurations() -> None:
    assert trial("arm", "d_optimal", env={"gamma": 3, "dt": 0.01}).columns() == {
        "env": "arm",
        "policy": "d_optimal",
        "model": "mlp",
        "learner": "adam_window",
        "width": 16,
        "depth": 2,
        "horizon": 30,
        "dt": 0.01,
        "gamma": 3.0,
        "label": "D-optimal, dt=0.01, γ=3, grid_points=[2, 2, 2, 2], horizon 30",
    }
    oracle = trial("arm", "oracle").columns()
    assert (oracle["width"], oracle["depth"]) == (None, None)


@settings(max_examples=50)
@given(
    mass=st.floats(1e-3, 1e3),
    start=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=2),
    width=st.integers(1, 300),
    rate=st.floats(1e-12, 1e3),
    seed=st.integers(0, 2**63 - 1),
)
def test_any_numbers_come_back(
    mass: float, start: list[float], width: int, rate: float, seed: int
) -> None:
    env = {"mass": mass, "initial_state": start}
    fields = {"env": env, "model": {"width": width}, "learner": {"learning_rate": rate}}
    spec = trial("pendulum", "d_optimal", seed, **fields)
    assert TrialSpec.from_mapping(spec.to_mapping()) == spec
    assert (spec.system.mass, spec.model.width, spec.seed) == (mass, width, seed)  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", [-1, 1.0, True, "3", None, 0.5])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(SpecificationError, match=r"^seed is .* whole number of 0 or above"):
        TrialSpec.from_mapping(trial("arm", "random").to_mapping() | {"seed": seed})


def test_an_unknown_section_is_answered_with_the_nearest() -> None:
    with pytest.raises(SpecificationError, match=r"'polcy' is unknown.*did you mean 'policy'\?"):
        TrialSpec.from_mapping(trial("arm", "random").to_mapping() | {"polcy": {}})


@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("given_value", [None, "pendulum", 3])
def test_a_section_has_to_be_one(section: str, given_value: Any) -> None:
    mapping = trial("arm", "random").to_mapping() | {section: given_value}
    with pytest.raises(SpecificationError, match=rf"'{section}' is .* a section"):
        TrialSpec.from_mapping(mapping)


LINEAR = {"name": "linear"}
LEAST_SQUARES = {"name": "recursive_least_squares"}


@pytest.mark.parametrize(
    ("env", "policy", "changes"),
    [
        ("quadrotor", "periodic", {}),
        ("pendulum", "periodic", {"env": {"name": "pendulum", "friction": 50.0}}),
        ("pendulum", "oracle", {"model": {"name": "mlp"}}),
        ("pendulum", "oracle", {"learner": {"name": "adam"}}),
        ("pendulum", "d_optimal", {"learner": LEAST_SQUARES}),
        ("pendulum", "random", {"model": LINEAR, "learner": LEAST_SQUARES}),
        ("pendulum", "uniform", {"model": LINEAR}),
    ],
)
def test_pairs_that_make_no_sense_are_told_apart_from_bad_values(
    env: str, policy: str, changes: dict[str, Any]
) -> None:
    possible = "arm" if policy == "periodic" else env
    mapping: dict[str, Any] = trial(possible, policy).to_mapping()
    mapping |= {"env": {"name": env}} | changes
    with pytest.raises(IncompatibleError) as caught:
        TrialSpec.from_mapping(mapping)
    assert isinstance(caught.value, SpecificationError)
    ends = (": change one of them.", ": choose another policy.")
    if env == "pendulum" and policy == "periodic":
        ends = (": set policy.frequency, or choose another policy.",)
    assert str(caught.value).endswith(ends)


@pytest.mark.parametrize(
    ("model", "learner", "sentence"),
    [
        (
            "rff",
            "ekf",
            "learner 'ekf' goes with model 'mlp', 'affine', 'black_box', 'linear' or 'grey_box' "
            "and model 'rff' with learner 'recursive_least_squares', but the two together were "
            "given",
        ),
        (
            "mlp",
            "recursive_least_squares",
            "learner 'recursive_least_squares' goes with model 'linear', 'linear_state' or 'rff' "
            "and model 'mlp' with learner 'adam', 'adam_window', 'adam_replay', 'ekf', "
            "'gauss_newton' or 'joint_ekf', but",
        ),
    ],
)
def test_which_learners_a_model_takes_and_which_models_a_learner_is_said(
    model: str, learner: str, sentence: str
) -> None:
    mapping = trial("arm", "random").to_mapping()
    del mapping["path"]
    mapping |= {"model": {"name": model}, "learner": {"name": learner}}
    with pytest.raises(IncompatibleError) as caught:
        TrialSpec.from_mapping(mapping)
    assert str(caught.value).startswith(sentence)


def test_the_linear_model_also_goes_with_d_optimal_inputs() -> None:
    spec = trial("pendulum", "oracle")
    mapping: dict[str, Any] = spec.to_mapping()
    mixed = TrialSpec.from_mapping(mapping | {"policy": {"name": "d_optimal"}})
    assert mixed.columns()["width"] is None


def test_the_key_of_a_stored_periodic_trial_stays() -> None:
    """Its section has held these entries since the first release."""
    spec = TrialSpec.from_names(env="pendulum", policy="periodic")
    assert '"policy":{"frequency":null,"name":"periodic"}' in spec.canonical_json()
