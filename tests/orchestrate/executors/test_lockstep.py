"""Batches in lockstep give the numbers of the trials run one by one, and come out as events."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dopt.result import TrialResult
from dopt.run import run_trial
from orchestrate.errors import LaunchError
from orchestrate.executors.base import Task, TaskDone
from orchestrate.executors.lockstep import LockstepExecutor
from orchestrate.records import Failure
from orchestrate.store import Reader
from tests.dopt.trials import trial

TRIALS = [trial("pendulum", "d_optimal", seed, env={"horizon": 8}) for seed in range(3)]


def test_a_chunk_is_run_as_one_batch() -> None:
    with LockstepExecutor("cpu", batch=3) as executor:
        executor.submit([Task(spec.trial_key, spec) for spec in TRIALS])
        events = executor.wait(0.1)
        assert executor.pending == 0
    assert [event.key for event in events if isinstance(event, TaskDone)] == [
        spec.trial_key for spec in TRIALS
    ]
    for event, spec in zip(events, TRIALS, strict=True):
        assert isinstance(event, TaskDone)
        assert isinstance(event.outcome, TrialResult)
        alone = run_trial(spec, "reference")
        assert event.outcome.loss == pytest.approx(alone.loss, rel=1e-9)
        assert event.outcome.inputs == pytest.approx(alone.inputs, rel=1e-9)


def test_what_cannot_run_together_is_every_trials_trouble() -> None:
    mixed = [TRIALS[0], trial("pendulum", "random", 1, env={"horizon": 8})]
    with LockstepExecutor("cpu", batch=2) as executor:
        executor.submit([Task(spec.trial_key, spec) for spec in mixed])
        outcomes = [event.outcome for event in executor.wait(0.1) if isinstance(event, TaskDone)]
    assert [isinstance(outcome, Failure) for outcome in outcomes] == [True, True]


@pytest.mark.parametrize("device", ["cuda:99", "banana", "meta"])
def test_a_device_that_is_not_there_is_a_sentence(device: str) -> None:
    with pytest.raises(LaunchError, match=f"executor.device is '{device}'.*executor.device=cpu"):
        LockstepExecutor(device, batch=2).start()


@pytest.mark.parametrize("grid", [["-m"], []])
def test_a_launch_on_a_device_that_is_not_there_is_refused_and_leaves_nothing(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path, grid: list[str]
) -> None:
    code, _, errors = command_line(
        "env.horizon=5", *grid, "seed=0", "executor=lockstep", "executor.device=cuda:99"
    )
    assert (code, errors.count("\n")) == (2, 1)
    assert errors.startswith("error: executor.device is 'cuda:99'")
    assert list(tmp_path.iterdir()) == []


def test_a_grid_runs_in_lockstep(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / 'results.db'}"
    grid = ("-m", "env=pendulum", "policy=random,oracle", "seed=range(4)", "env.horizon=6")
    code, _, errors = command_line(
        *grid, "executor=lockstep", "executor.batch=3", f"store.url={url}"
    )
    assert code == 0, errors
    with Reader.open(url) as reader:
        assert [config.n_done for config in reader.configs()] == [4, 4]


def test_lockstep_and_the_kernel_keep_their_trials_apart(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """Their numbers agree to rounding only: one must not be taken for the other."""
    url = f"sqlite:///{tmp_path / 'results.db'}"
    one = ("env=pendulum", "policy=oracle", "seed=1", "env.horizon=6", f"store.url={url}")
    assert command_line(*one, "executor=lockstep")[0] == 0
    assert command_line(*one, "executor=inprocess")[0] == 0
    with Reader.open(url) as reader:
        assert sorted(str(config.config["path"]) for config in reader.configs()) == [
            "kernel",
            "reference",
        ]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
def test_a_grid_runs_on_a_gpu(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / 'results.db'}"
    grid = ("-m", "env=pendulum", "policy=random,d_optimal", "seed=range(4)", "env.horizon=6")
    device = ("executor=lockstep", "executor.device=cuda:0")
    code, _, errors = command_line(*grid, *device, f"store.url={url}")
    assert code == 0, errors
    with Reader.open(url) as reader:
        assert [config.n_done for config in reader.configs()] == [4, 4]
