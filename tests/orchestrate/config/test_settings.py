"""Defaults in conf/*.yaml and in the classes: both hold the same numbers."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from dopt.control.task import Control
from dopt.errors import SpecificationError
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.registry import build
from dopt.spec.trial import TrialSpec
from dopt.systems import NAMED_SYSTEMS
from orchestrate.config import RETRY, Combination, LaunchSettings, build_grid
from orchestrate.config.command_line import read_command_line
from orchestrate.config.options import option_names
from orchestrate.store import RETRIED
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


def test_every_registered_choice_is_an_option() -> None:
    last = {group: {name.split("/")[-1] for name in option_names(group)} for group in CLASSES}
    for group, registry in {"policy": POLICIES, "model": MODELS, "learner": LEARNERS}.items():
        assert last[group] >= set(registry)
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


SETTINGS: dict[str, Any] = {
    "env": {"name": "pendulum"},
    "policy": {"name": "random"},
    "model": {"name": "mlp"},
    "learner": {"name": "adam"},
    "seed": 0,
}


def combination(seeds: tuple[int, ...] | None = (0, 1), **sections: object) -> Combination:
    return Combination({**SETTINGS, **sections}, seeds)


def test_every_config_gets_its_first_seed_before_any_gets_its_second() -> None:
    grid = build_grid([combination(), combination(policy={"name": "uniform"})])
    order = [(trial.policy.name, trial.seed) for trial in grid.trials]
    assert order == [("random", 0), ("uniform", 0), ("random", 1), ("uniform", 1)]


def test_a_trial_that_is_named_twice_is_one_trial() -> None:
    """Also by an integer and an equal float."""
    grid = build_grid([combination((0, 1, 1)), combination(None, env={"name": "pendulum"})])
    assert [trial.seed for trial in grid.trials] == [0, 1]
    assert (grid.n_jobs, grid.repeats) == (4, 2)
    grid = build_grid(
        [combination((0,), env={"name": "pendulum", "gamma": gamma}) for gamma in (2, 2.0)]
    )
    assert len(grid.trials) == 1


OWN_GRID = {"_target_": "tests.dopt.custom_networks.Stack"}


def test_a_grid_holds_trials_of_both_paths() -> None:
    grid = build_grid([combination(), combination(model=OWN_GRID)])
    paths = {(trial.model.name, trial.config.path) for trial in grid.trials}
    assert paths == {("mlp", "kernel"), ("Stack", "reference")}
    together = grid.on_path("reference")
    assert {trial.config.path for trial in together.trials} == {"reference"}
    same = [trial.trial_key for trial in together.trials if trial.model.name == "Stack"]
    assert same == [trial.trial_key for trial in grid.trials if trial.model.name == "Stack"]


@pytest.mark.parametrize(
    ("section", "target", "sentence"),
    [
        ("policy", "custom_plugins.Unfinished", r"planner\(\) of policy 'unfinished' .*choose"),
        ("policy", "test_plugins.Bringing", r"planner\(\) of policy 'bringing' returned None"),
        ("learner", "test_plugins.Teaching", r"updater\(\) of learner 'teaching' returned None"),
    ],
)
def test_a_class_whose_plan_or_update_lacks_a_method_is_refused(
    section: str, target: str, sentence: str
) -> None:
    own = combination(**{section: {"_target_": f"tests.dopt.{target}"}})
    with pytest.raises(SpecificationError, match=sentence):
        build_grid([combination(), own])


CommandLine = Callable[..., tuple[int, str, str]]

TRIAL = ("env.horizon=5", "executor=inprocess")


@pytest.mark.parametrize(
    "words",
    [
        ["launch.timeout=null", "launch.memory_gib=1.5"],
        ["launch.timeout=0.5", "launch.memory_gib=2", "launch.retry_memory=1.5"],
        ["launch.timeout=7", "launch.lease=20", "launch.patience=10.5", "assess.sample_loss=true"],
    ],
    ids=" ".join,
)
def test_what_is_taken(command_line: CommandLine, words: list[str]) -> None:
    code, output, errors = command_line(*TRIAL, *words)
    assert (code, errors) == (0, "")
    assert "final loss" in output


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("launch.timeout=0", "launch.timeout is 0, but null or a number of seconds above 0"),
        ("launch.timeout=inf", "launch.timeout is inf, but null or a number of seconds"),
        ("launch.timeout=true", "launch.timeout"),
        ("launch.memory_gib=0", "launch.memory_gib is 0, but null or a number of GiB above 0"),
        ("launch.retry_memory=2", "launch.retry_memory is 2, but there is no limit that it could"),
        ("launch.retry_memory=1", "launch.retry_memory is 1, but null or a factor above 1, at mo"),
        ("launch.until=ci<5%", "a single trial is asked for: add -m"),
        ("launch.until=ci<0%", "launch.until is 'ci<0%', but null or ci<P%"),
        ("launch.until=ci<5", "P percent), such as 'ci<5%', is expected: change launch.until."),
        ("launch.until=5", "launch.until is 5, but null or ci<P%"),
        ("launch.lease=null", "launch.lease is null, but"),
        ("launch.detach=null", "launch.detach is null, but"),
        ("assess.sample_loss=yes please", "'assess' is {'sample_loss': 'yes please'}, but"),
        ("launch.lease=10", "launch.patience is 30, but less than launch.lease=10 is expected"),
    ],
)
def test_what_is_refused(command_line: CommandLine, word: str, sentence: str) -> None:
    code, output, errors = command_line(*TRIAL, word)
    assert (code, output, errors.count("\n")) == (2, "", 1)
    assert sentence in errors


GRID = ("-m", "policy=d_optimal,random", "env.horizon=5", "seed=range(20)", "executor=inprocess")


@pytest.mark.parametrize("until", ["ci<5%", "ci < 12.5 %", "'ci<5%'"])
def test_a_command_line_takes_a_rule(command_line: CommandLine, until: str) -> None:
    code, output, errors = command_line(*GRID, f"launch.until={until}")
    assert (code, "error:" in errors) == (0, False), errors
    assert "40 of 40 trials (100 %), 0 of 2 means known" in output


def test_a_dry_run_says_that_these_are_the_most(command_line: CommandLine) -> None:
    output = command_line(*GRID, "launch.until=ci<5%", "launch.dry_run=true")[1]
    assert output.endswith("launch.until may need fewer of these seeds: they are run in batches\n")


SEVERAL = """
# @package _global_
hydra:
  sweeper:
    params: {env: arm, seed: "range(0,3)"}
    grids:
      - {policy: "random,uniform"}
      - {policy: uniform, env: "arm,pendulum"}
"""


def test_a_launch_retries_what_the_command_retries() -> None:
    assert {*RETRY} == {*RETRIED}


TYPED = """
# @package _global_
hydra:
  sweeper:
    grids: [{policy: beyond/task, policy.goal: [1, 0.5], policy.count: 3, seed: 7}]
"""
"""A grid has the values of YAML."""


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("-m", 0, "9 trials, 0 done, 9 to run"),  # 2 × 3 and 2 × 3, of which 3 are the same
        ("-m seed=5 env=pendulum", 0, "2 trials, 0 done, 2 to run"),  # holds for every grid
        ("seed=5 env=pendulum", 2, "experiment=several is a grid (policy=uniform): add -m"),
        ("-m policy.iterations=3", 0, "policy.iterations applies to policy=uniform only\n"),
        ("-m policy.iteratons=3", 2, "did you mean 'iterations'? Choose one of iterations."),
        ("-m experiment=typed", 0, "1 trial, 0 done, 1 to run"),
    ],
)
def test_an_experiment_can_be_several_grids(
    command_line: CommandLine, tmp_path: Path, words: str, code: int, said: str
) -> None:
    """A setting counts no grid that never asked for it."""
    folder = tmp_path / "settings/experiment"
    folder.mkdir(parents=True)
    (folder / "several.yaml").write_text(SEVERAL)
    (folder / "typed.yaml").write_text(TYPED)
    chosen = [] if "experiment=" in words else ["experiment=several"]
    given = ["--config-dir", str(folder.parent), *chosen, *words.split(), "launch.dry_run=true"]
    found, output, errors = command_line(*given)
    assert (found, bool(errors)) == (code, code != 0)
    assert said in output + errors
    assert "applies to" not in output or output.startswith(said)


SHORT = ("env.horizon=5", "executor=inprocess")


@pytest.mark.parametrize(
    ("words", "note", "trials"),
    [
        (  # 2 random, 2 uniform, 4 D-optimal
            "env=arm policy=random,uniform,d_optimal policy.regularization=1e-2,1e-3 model.depth=1 "
            "seed=0,1",
            "policy.regularization applies to policy=d_optimal only\n",
            8,
        ),
        ("policy=beyond/exact,beyond/trace policy.budget_us=20 seed=0", "", 2),
        (
            "policy=d_optimal,beyond/exact policy.candidates=8 seed=0",
            "policy.candidates applies to policy=exact only\n",
            2,
        ),
        (
            "learner=ekf,adam_window learner.forgetting=0.99 seed=0",
            "learner.forgetting applies to learner=ekf only\n",
            2,
        ),
        ("task=none,control task.steps=60 seed=0", "task.steps applies to task=control only\n", 2),
        ("policy=random,oracle model.depth=3 seed=0", "model.depth applies to model=mlp only\n", 2),
    ],
)
def test_a_setting_holds_for_the_choices_that_have_it(
    command_line: CommandLine, words: str, note: str, trials: int
) -> None:
    code, output, errors = command_line("-m", *words.split(), "launch.dry_run=true")
    assert (code, errors) == (0, "")
    assert output.startswith(note or "env ")
    assert output.count(" applies to ") == bool(note)
    assert f"{trials} trials, 0 done, {trials} to run" in output


def test_a_setting_of_the_launch_may_refer_to_one_of_a_trial(
    command_line: CommandLine, tmp_path: Path
) -> None:
    named = "store.url=sqlite:///of${env.horizon}.db"
    assert command_line("-m", "policy=random,oracle", "seed=0", named, *SHORT)[0] == 0
    assert (tmp_path / "of5.db").exists()
