"""Specifications of trials: content and keys, labels, the options of conf/, refusals."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Mapping
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.errors import IncompatibleError, SpecificationError
from dopt.policies import POLICIES, TITLES
from dopt.run import run_trial
from dopt.spec.config import completed, config_label, labels, value_label
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum, System
from dopt.systems.properties import jacobians
from tests.analysis.synthetic import make_spec
from tests.dopt.trials import ALL_PAIRS, covering, trial
from tests.paths import CONF

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
    for env, policy in covering(ALL_PAIRS):
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


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))
def test_only_the_trial_key_depends_on_the_seed(first: int, second: int) -> None:
    one, two = trial("arm", "uniform", first), trial("arm", "uniform").with_seed(second)
    assert one.config_key == two.config_key
    assert one.config_json == two.config_json
    assert (one.trial_key == two.trial_key) == (first == second)


def test_the_key_does_not_depend_on_how_a_value_is_written() -> None:
    spec = trial("pendulum", "d_optimal", env={"mass": 1, "initial_state": [0, 0]})
    env = {"initial_state": (0.0, -0.0), "grid_points": (4, 4), "mass": 1.0, "horizon": 30}
    same: dict[str, Any] = {
        "seed": 0,
        "learner": {"name": "adam_window"},
        "model": {"depth": 2, "width": 16, "name": "mlp"},
        "policy": {"regularization": 0.001, "name": "d_optimal"},
        "env": env | {"name": "pendulum"},
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


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        *(
            ({"seed": seed}, "^seed is .* whole number from 0 to 9")
            for seed in (-1, 1.0, True, "3", None)
        ),
        ({"polcy": {}}, r"'polcy' is unknown.*did you mean 'policy'\?"),
        *(({section: "pendulum"}, rf"'{section}' is .* a section") for section in SECTIONS),
        *(({"env": wrong}, "'env' is .* a section") for wrong in (None, 3)),
        (
            {"path": None, "model": {"name": "rff"}, "learner": {"name": "ekf"}},
            "^learner 'ekf' goes with model 'mlp', 'affine', 'black_box', 'linear' or 'grey_box' "
            "and model 'rff' with learner 'recursive_least_squares', but the two together were ",
        ),
        (
            {"path": None, "learner": {"name": "recursive_least_squares"}},
            "^learner 'recursive_least_squares' goes with model 'linear', 'linear_state' or 'rff' "
            "and model 'mlp' with learner 'adam', 'adam_window', 'adam_replay', 'ekf' or "
            "'gauss_newton', but",
        ),
    ],
)
def test_a_wrong_mapping_is_refused_in_a_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        TrialSpec.from_mapping(trial("arm", "random").to_mapping() | changes)


LINEAR = {"name": "linear"}
LEAST_SQUARES = {"name": "recursive_least_squares"}


@pytest.mark.parametrize(
    ("policy", "changes"),
    [
        ("periodic", {"env": {"name": "quadrotor"}}),
        ("oracle", {"model": {"name": "mlp"}}),
        ("oracle", {"learner": {"name": "adam"}}),
        ("d_optimal", {"learner": LEAST_SQUARES}),
        ("random", {"model": LINEAR, "learner": LEAST_SQUARES}),
        ("uniform", {"model": LINEAR}),
    ],
)
def test_pairs_that_make_no_sense_are_told_apart_from_bad_values(
    policy: str, changes: dict[str, Any]
) -> None:
    with pytest.raises(IncompatibleError, match=r": (change one of them|choose another policy)\.$"):
        TrialSpec.from_mapping(trial("arm", policy).to_mapping() | changes)


Config = Mapping[str, object]


def config(system: str, name: str, **sections: Mapping[str, object]) -> Config:
    """Return the stored form of a configuration; ``sections`` override fields."""
    found: Config = json.loads(make_spec(system, name, 0, **sections).config_json)
    return found


PLAIN = config("pendulum", "d_optimal")
BOUND = config("pendulum", "d_optimal", env={"gamma": 3})
REPLAY = config("pendulum", "d_optimal", learner={"name": "adam_replay", "steps": 60})
WIDE = config("pendulum", "d_optimal", model={"width": 64})
FRESH = config("pendulum", "d_optimal", policy={"information": "fresh"})
ORACLE = config("pendulum", "oracle")
RANDOM = config("pendulum", "random")
TASK = config("pendulum", "random", task={"name": "control"})
RAIL = {"bounds": {"φ": [-2.0, 2.0]}}
ENFORCED = config("pendulum", "d_optimal", limits=RAIL)
COUNTED = config("pendulum", "d_optimal", limits={**RAIL, "enforced": False})
CARTPOLE = config("cartpole", "d_optimal")
ALL = (PLAIN, BOUND, REPLAY, WIDE, ORACLE, RANDOM, TASK, ENFORCED, COUNTED)


def boat(mass: float) -> Config:
    """Return a configuration with a system of a class that is not loaded."""
    env = {"name": "boat", "_target_": "my_module.Boat", "source": "0" * 16, "mass": mass}
    return {**PLAIN, "env": env}


@pytest.mark.parametrize(
    ("one", "label"),
    [
        (PLAIN, "D-optimal"),
        (BOUND, "D-optimal, γ=3"),
        (REPLAY, "D-optimal, adam_replay ×60"),
        (WIDE, "D-optimal, width 64"),
        (FRESH, "D-optimal, information=fresh"),
        (ORACLE, "oracle"),
        (TASK, "random, task control"),
        (ENFORCED, "D-optimal, limits, φ=[-2, 2]"),
        (COUNTED, "D-optimal, limits, φ=[-2, 2], enforced=False"),
        (boat(1.0), "D-optimal"),
    ],
)
def test_a_stored_label_says_what_is_not_the_default(one: Config, label: str) -> None:
    assert config_label(one) == label


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        ([PLAIN], ["D-optimal"]),
        ([BOUND], ["D-optimal"]),
        ([PLAIN, BOUND], ["D-optimal", "γ=3"]),
        ([PLAIN, REPLAY], ["D-optimal", "adam_replay ×60"]),
        ([PLAIN, FRESH], ["D-optimal", "information=fresh"]),
        ([completed(PLAIN), FRESH], ["D-optimal", "information=fresh"]),
        ([PLAIN, RANDOM, BOUND], ["D-optimal", "random", "D-optimal, γ=3"]),
        ([RANDOM, TASK], ["random", "task control"]),
        ([PLAIN, ENFORCED], ["D-optimal", "limits, φ=[-2, 2]"]),
        ([ENFORCED], ["D-optimal, limits"]),
        ([COUNTED], ["D-optimal, limits, enforced=False"]),
        ([ENFORCED, COUNTED], ["D-optimal, limits", "D-optimal, limits, enforced=False"]),
        ([PLAIN, CARTPOLE, RANDOM], ["D-optimal", "D-optimal", "random"]),
        ([boat(1.0), boat(2.0)], ["mass=1", "mass=2"]),
        ([], []),
    ],
)
def test_labels_beside_each_other_say_only_what_differs(
    shown: list[Config], expected: list[str]
) -> None:
    """Environments are not compared, and the order in which they are given does not matter."""
    assert labels(shown) == expected
    assert labels(shown[::-1]) == expected[::-1]


def test_no_two_configurations_share_a_label() -> None:
    close = [config("pendulum", "random", env={"gamma": 1 + 1e-9 * step}) for step in range(3)]
    older = {**PLAIN, "code_version": 0}
    for pair in combinations((*ALL, *close, older), 2):
        assert len(set(labels(pair))) == 2, pair
    assert len(set(labels((*ALL, *close, older)))) == len(ALL) + 4


def test_a_class_and_its_file_are_named_only_where_nothing_else_differs() -> None:
    env = {"name": "boat", "_target_": "my_module.Boat", "mass": 2.0}
    policy = {"name": "curiosity", "_target_": "my_module.Curiosity", "candidates": 32}
    old, new = ({**section, "source": digit * 16} for section, digit in ((env, "0"), (env, "1")))
    plain, edited = ({**PLAIN, "env": one} for one in (old, new))
    own = {**plain, "policy": {**policy, "source": "2" * 16}}
    many = {**own, "policy": {**policy, "source": "2" * 16, "candidates": 64}}
    again = {**own, "policy": {**policy, "source": "3" * 16}}
    heavy = {**edited, "env": {**new, "mass": 3.0}}
    assert labels([plain, own]) == ["D-optimal", "curiosity"]
    sizes = (f"curiosity, candidates={size}" for size in (32, 64))
    assert labels([plain, own, many]) == ["D-optimal", *sizes]
    assert labels([plain, heavy]) == ["mass=2", "mass=3"]
    assert labels([plain, edited]) == [f"D-optimal, source={digit * 16}" for digit in "01"]
    files = (f"curiosity, source={digit * 16}" for digit in "23")
    assert labels([plain, own, again]) == ["D-optimal", *files]


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("policy", "d_optimal", "D-optimal"),
        ("policy", "my_own", "my own"),
        ("learner", "adam_replay", "adam_replay"),
        ("env.gamma", 3.0, "γ=3"),
        ("width", 64, "width 64"),
        ("width", None, "no width"),
        ("policy.criterion", "joint", "criterion=joint"),
    ],
)
def test_a_value_has_words_of_its_own(path: str, value: object, text: str) -> None:
    assert set(TITLES) == set(POLICIES), "every shipped policy has a title"
    assert value_label(path, value) == text


UNSTABLE_AT_REST = {"moving_star", "van_der_pol"}
"""A star that pushes away, and an oscillator that is fed."""


def reasons_of(name: str) -> str:
    """Return the reasons for the numbers of a system, in its file or its class, on one line."""
    path = CONF / f"env/{name}.yaml"
    text = path.read_text() if path.exists() else str(SYSTEMS[name].__doc__)
    return " ".join(line.lstrip("# ") for line in text.splitlines())


def euler_spectral_radius(system: System) -> float:
    """Return the spectral radius of x -> x + dt f(x, 0) at the stable equilibrium."""
    state = system.equilibrium or system.initial_state
    A, _ = jacobians(system, state, np.zeros(system.n_inputs))
    return float(np.max(np.abs(1 + system.dt * np.linalg.eigvals(A))))


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_euler_map_is_stable_where_the_system_is(name: str) -> None:
    """Where motions about rest grow, the map's grow alike up to O(dt²)."""
    system = SYSTEMS[name]()
    rest = system.equilibrium or system.initial_state
    values = np.linalg.eigvals(jacobians(system, rest, np.zeros(system.n_inputs))[0])
    growth = values.real.max()
    stated = re.search(r"spectral radius (0\.\d+) at rest", reasons_of(name))
    assert stated is None or stated[1] == f"{euler_spectral_radius(system):.3f}"
    if growth <= 1e-12:
        assert euler_spectral_radius(system) <= 1.0 + 1e-12
        return
    assert name in UNSTABLE_AT_REST
    farthest = (system.dt * np.abs(values).max()) ** 2
    assert euler_spectral_radius(system) <= math.exp(growth * system.dt) + farthest < 1.05


@pytest.mark.parametrize(("name", "field"), [("chain", "friction"), ("cartpole", "pivot_friction")])
def test_the_least_friction_of_a_stable_euler_map_is_the_stated_one(name: str, field: str) -> None:
    stated = re.search(r"takes (0\.\d+) at least", reasons_of(name))
    assert stated
    bound, last_digit = float(stated[1]), 10.0 ** -(len(stated[1]) - 2)
    radii = [
        euler_spectral_radius(dataclasses.replace(SYSTEMS[name](), **{field: friction}))
        for friction in (bound - last_digit, bound)
    ]
    assert radii[0] > 1.0 + 1e-9
    assert radii[1] <= 1.0 + 1e-12


@pytest.mark.parametrize("name", [name for name in SYSTEMS if name != "moving_star"])
def test_a_trial_starts_close_to_rest(name: str) -> None:
    """All except the star's, which pushes at once."""
    system = SYSTEMS[name]()
    rest = np.array(system.equilibrium or np.zeros(system.n_states))
    rest[[i for i, label in enumerate(system.state_labels) if label.startswith("e₀")]] = 1.0
    assert system.initial_state == pytest.approx(rest, abs=0.01)


CASES: list[tuple[Callable[..., Any], tuple[Any, ...], str]] = [
    (
        TrialSpec.from_names,
        (Pendulum(), "random"),
        r"key 'env' is a Pendulum, but a name or a section is .* to TrialSpec\.of_system",
    ),
    (TrialSpec.from_names, ("pendulum", 3), r"configuration key 'policy' is 3, but a section"),
    (TrialSpec.of_system, (Pendulum, "random"), r"is the class Pendulum, but an object such as"),
    (TrialSpec.of_system, ("pendulum", "random"), r"is 'pendulum', .* TrialSpec\.from_names,"),
    (TrialSpec.of_system, (Pendulum(), None), r"configuration key 'policy' is None, but a section"),
    (run_trial, ("pendulum",), r"run_trial was given 'pendulum', but a TrialSpec is expected"),
]


@pytest.mark.parametrize(("call", "arguments", "sentence"), CASES)
def test_another_kind_of_thing_is_refused_in_a_sentence(
    call: Callable[..., Any], arguments: tuple[Any, ...], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        call(*arguments)


@pytest.mark.parametrize("section", ["limits", "task"])
def test_an_option_none_takes_nothing_else(section: str) -> None:
    spec = trial("cartpole", "random")
    given = {**spec.to_mapping(), section: {"name": "none", "steps": 3}}
    with pytest.raises(SpecificationError, match=f"{section}=none has steps, but no other key"):
        TrialSpec.from_mapping(given)
    assert TrialSpec.from_mapping({**given, section: {"name": "none"}}) == spec
