"""Defaults in conf/*.yaml and in the classes: both hold the same numbers."""

from __future__ import annotations

import dataclasses
import sys
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
from dopt.spec.trial import TrialSpec
from dopt.systems import NAMED_SYSTEMS
from orchestrate.config import build_grid
from orchestrate.config.command_line import read_command_line
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.options import option_names
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
    """Hydra accepts only overrides of existing keys, so that these files repeat all fields."""
    group = path.parts[0]
    given = section(path, group)
    cls = CLASSES[group][given["name"]]
    assert build(group, CLASSES[group], given) == cls()
    assert set(given) == {"name", *(field.name for field in dataclasses.fields(cls))}


OWN = """
defaults:
  - beyond/chain
  - _self_
n_links: 3
"""
"""A user's option that changes one number of a class without a file."""


def keys(monkeypatch: pytest.MonkeyPatch, *words: str) -> list[str]:
    """Return the keys of the trials that a command line asks for."""
    monkeypatch.setattr(sys, "argv", ["launch.py", *words])
    request = read_command_line()
    assert request is not None
    return [trial.trial_key for trial in build_grid(request.combinations).trials]


def test_every_system_and_policy_is_an_option() -> None:
    last = {group: {name.split("/")[-1] for name in option_names(group)} for group in CLASSES}
    assert last["policy"] >= set(POLICIES)
    assert last["env"] >= {name.removeprefix("mujoco_") for name in NAMED_SYSTEMS}
    assert option_names("env")[:5] == ["arm", "cartpole", "pendulum", "quadrotor", "beyond/car"]


def test_an_option_without_a_file_is_the_default_of_its_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ("-m", "env=beyond/chain", "policy=glob([baseline/*,beyond/exact])", "seed=3")
    names = ["chirp", "multisine", "periodic_square", "prbs", "random_held", "random_sphere"]
    expected = [
        TrialSpec.from_names("chain", policy, seed=3).trial_key for policy in (*names, "exact")
    ]
    assert keys(monkeypatch, *words) == expected


def test_options_of_a_folder_of_the_user_build_on_those_of_classes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "short_chain.yaml").write_text(OWN)
    given = ("-m", "--config-dir", str(tmp_path), "policy=d_optimal,random", "seed=range(2)")
    ours = keys(monkeypatch, *given, "env=glob(short*)")
    assert ours == keys(monkeypatch, *given, "env=beyond/chain", "env.n_links=3")
    assert len(ours) == 4
    both = keys(monkeypatch, *given, "env=glob([short*,p*])")
    assert set(both) == {*ours, *keys(monkeypatch, *given, "env=pendulum")}


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
