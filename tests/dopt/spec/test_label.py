"""Labels name what differs, and no two configurations of an environment share one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import combinations

import pytest

from dopt.policies import POLICIES, TITLES
from dopt.spec.label import config_label, labels, value_label
from dopt.spec.trial import TrialSpec

Config = Mapping[str, object]


def config(system: str, name: str, **sections: Mapping[str, object]) -> Config:
    """Return the stored form of a configuration; ``sections`` override fields."""
    linear = name == "oracle"
    mapping: dict[str, Mapping[str, object]] = {
        "env": {"name": system},
        "policy": {"name": name},
        "model": {"name": "linear" if linear else "mlp"},
        "learner": {"name": "recursive_least_squares" if linear else "adam_window"},
    }
    for key, fields in sections.items():
        mapping[key] = {**mapping.get(key, {}), **fields}
    found: Config = json.loads(TrialSpec.from_mapping(mapping).config_json)
    return found


PLAIN = config("pendulum", "d_optimal")
BOUND = config("pendulum", "d_optimal", env={"gamma": 3})
REPLAY = config("pendulum", "d_optimal", learner={"name": "adam_replay", "steps": 60})
WIDE = config("pendulum", "d_optimal", model={"width": 64})
ORACLE = config("pendulum", "oracle")
RANDOM = config("pendulum", "random")
TASK = config("pendulum", "random", task={"name": "control"})
RAIL = {"bounds": {"φ": [-2.0, 2.0]}}
ENFORCED = config("pendulum", "d_optimal", limits=RAIL)
COUNTED = config("pendulum", "d_optimal", limits={**RAIL, "enforced": False})
ALL = (PLAIN, BOUND, REPLAY, WIDE, ORACLE, RANDOM, TASK, ENFORCED, COUNTED)


@pytest.mark.parametrize(
    ("one", "label"),
    [
        (PLAIN, "D-optimal"),
        (BOUND, "D-optimal, γ=3"),
        (REPLAY, "D-optimal, adam_replay ×60"),
        (WIDE, "D-optimal, width 64"),
        (ORACLE, "oracle"),
        (TASK, "random, task control"),
        (ENFORCED, "D-optimal, limits, φ=[-2, 2]"),
        (COUNTED, "D-optimal, limits, φ=[-2, 2], enforced=False"),
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
        ([PLAIN, RANDOM], ["D-optimal", "random"]),
        ([PLAIN, RANDOM, BOUND], ["D-optimal", "random", "D-optimal, γ=3"]),
        ([RANDOM, TASK], ["random", "task control"]),
        ([PLAIN, ENFORCED], ["D-optimal", "limits, φ=[-2, 2]"]),
        ([ENFORCED], ["D-optimal, limits"]),
        ([COUNTED], ["D-optimal, limits, enforced=False"]),
        ([ENFORCED, COUNTED], ["D-optimal, limits", "D-optimal, limits, enforced=False"]),
        ([], []),
    ],
)
def test_labels_beside_each_other_say_only_what_differs(
    shown: list[Config], expected: list[str]
) -> None:
    assert labels(shown) == expected


def test_settings_of_different_environments_are_not_compared() -> None:
    shown = [PLAIN, RANDOM, config("cartpole", "d_optimal"), config("cartpole", "random")]
    assert labels(shown) == ["D-optimal", "random", "D-optimal", "random"]


def test_no_two_configurations_share_a_label() -> None:
    close = [config("pendulum", "random", env={"gamma": 1 + 1e-9 * step}) for step in range(3)]
    older = {**PLAIN, "code_version": 0}
    for pair in combinations((*ALL, *close, older), 2):
        assert len(set(labels(pair))) == 2, pair
    assert len(set(labels((*ALL, *close, older)))) == len(ALL) + 4


def test_the_order_in_which_they_are_given_does_not_matter() -> None:
    assert labels(ALL[::-1]) == labels(ALL)[::-1]


def test_settings_of_a_class_that_is_not_loaded_are_told_apart() -> None:
    env = {"name": "boat", "_target_": "my_module.Boat", "source": "0" * 16}
    boats = [{**PLAIN, "env": {**env, "mass": mass}} for mass in (1.0, 2.0)]
    assert [config_label(boat) for boat in boats] == ["D-optimal", "D-optimal"]
    assert labels(boats) == ["mass=1", "mass=2"]


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
    assert labels([plain, own, many]) == [
        "D-optimal",
        "curiosity, candidates=32",
        "curiosity, candidates=64",
    ]
    assert labels([plain, heavy]) == ["mass=2", "mass=3"]
    assert labels([plain, edited]) == [f"D-optimal, source={digit * 16}" for digit in "01"]
    assert labels([plain, own, again]) == [
        "D-optimal",
        *(f"curiosity, source={digit * 16}" for digit in "23"),
    ]


def test_every_shipped_policy_has_a_title() -> None:
    assert set(TITLES) == set(POLICIES)


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
    assert value_label(path, value) == text
