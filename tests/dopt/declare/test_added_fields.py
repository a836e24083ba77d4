"""A field that is added later leaves keys as they are, and stored configurations are completed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, ClassVar

import pytest

from dopt.fields import parameter
from dopt.policies import POLICIES
from dopt.policies.base import CompiledPolicy
from dopt.registry import added_defaults, build, identifying_section, section_of
from dopt.spec.config import completed
from dopt.spec.label import config_label, labels
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial


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
    from orchestrate.store.doctor import examine
    from tests.analysis.synthetic import fill

    for spec in (PLAIN, FRESH):
        assert trial_key(spec.config_json, spec.seed) == spec.trial_key
    url = f"sqlite:///{tmp_path}/results.db"
    fill(url, [PLAIN, FRESH])
    assert examine(url, trial_key) == []
