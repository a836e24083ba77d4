"""Defaults in conf/*.yaml and in the classes: both hold the same numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from dopt.control.task import Control
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.registry import build
from dopt.systems import NAMED_SYSTEMS
from orchestrate.config.launch_settings import LaunchSettings
from tests.paths import ROOT

CONF = ROOT / "conf"
CLASSES: Mapping[str, Mapping[str, Any]] = {
    "env": NAMED_SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
    "task": {"control": Control},
}
FILES = [
    path.relative_to(CONF)
    for group in CLASSES
    for path in sorted((CONF / group).rglob("*.yaml"))
    if path.name != "none.yaml"
]


def section(path: Path, group: str) -> dict[str, Any]:
    """Return the section of a group in a file, with the default width."""
    text = (CONF / path).read_text().replace("${width}", "16")
    plain = OmegaConf.to_container(OmegaConf.create(text))
    assert isinstance(plain, dict)
    found = plain.get(group, plain)
    fields = {field.name for field in dataclasses.fields(CLASSES[group][found["name"]])}
    return {key: value for key, value in found.items() if key in fields | {"name"}}


@pytest.mark.parametrize("path", FILES, ids=str)
def test_a_file_builds_the_default_of_its_class(path: Path) -> None:
    """Hydra accepts only overrides of existing keys, so that the files repeat all fields."""
    group = path.parts[0]
    given = section(path, group)
    cls = CLASSES[group][given["name"]]
    assert build(group, CLASSES[group], given) == cls()
    assert set(given) == {"name", *(field.name for field in dataclasses.fields(cls))}


def test_a_launch_has_the_default_settings() -> None:
    launch = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").launch)
    given = {
        "launch": launch,
        "store": {"url": "sqlite:///results.db"},
        "executor": {"name": "local"},
    }
    default = LaunchSettings("local", "sqlite:///results.db")
    assert LaunchSettings.from_mapping(given) == default


def test_a_batch_has_the_default_size_and_device() -> None:
    from orchestrate.executors.lockstep import BATCH_SIZE, DEVICE

    content = OmegaConf.load(CONF / "executor" / "lockstep.yaml")
    assert (content.device, content.batch) == (DEVICE, BATCH_SIZE)
