"""Runs of trackers from a database: read back by the libraries that others use."""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt.spec.trial import TrialSpec
from tests.analysis.synthetic import fake_results, fill, make_grid

TASK = {"task": {"name": "control", "checkpoints": [10]}}
SPECS = make_grid(("pendulum", "cartpole"), ("random",), range(2), env={"horizon": 20}, **TASK)
SPECS += make_grid(("arm",), ("random",), range(1), env={"horizon": 20})
LOST = {SPECS[-1].trial_key: 12}
RESULTS = dict(zip([spec.trial_key for spec in SPECS], fake_results(SPECS, LOST), strict=True))


@pytest.fixture(autouse=True)
def _warnings_of_libraries() -> Iterator[None]:
    """Let the libraries warn of what they use of others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture
def results(tmp_path: Path) -> Path:
    fill(f"sqlite:///{tmp_path}/r.db", SPECS, diverged=LOST)
    return tmp_path / "r.db"


def losses(spec: TrialSpec) -> list[float]:
    found = RESULTS[spec.trial_key]
    return [float(value) for value in found.loss[: found.n_steps]]


def test_mlflow_reads_every_run(results: Path, tmp_path: Path) -> None:
    pytest.importorskip("mlflow")
    from mlflow import MlflowClient

    from studies.trackers.mlflow_runs import write_runs

    write_runs(results, tmp_path / "mlflow.db")
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path}/mlflow.db")
    names = [one.experiment_id for one in client.search_experiments()]
    found = {run.data.tags["trial_key"]: run for run in client.search_runs(names)}
    assert set(found) == set(RESULTS)
    for spec in SPECS:
        run, result = found[spec.trial_key], RESULTS[spec.trial_key]
        shown = (run.data.params["env.name"], run.data.params["seed"])
        assert shown == (spec.system.name, str(spec.seed))
        assert run.data.tags["status"] == ("diverged" if spec.trial_key in LOST else "done")
        history = client.get_metric_history(run.info.run_id, "loss")
        assert [one.value for one in history] == losses(spec)
        assert [one.step for one in history] == list(range(result.n_steps))
        if spec.trial_key not in LOST:
            assert run.data.metrics["final_loss"] == result.final_loss
        costs = [row for row in result.assessments if row.measure == "control_cost"]
        history = client.get_metric_history(run.info.run_id, "control_cost")
        assert [(one.step, one.value) for one in history] == [(c.t, c.value) for c in costs]


# Records of an offline run of Weights & Biases, which its library no longer reads in Python. A file
# has a head of 7 bytes and then blocks of 32 KiB of LevelDB's log format. The records are parsed by
# the library's own message classes.

_HEAD = 7
_BLOCK = 32_768
_WHOLE, _LAST = 1, 4


@dataclass
class OfflineRun:
    """One run: its name, configuration, rows of the history, and last summary."""

    name: str = ""
    project: str = ""
    config: dict[str, Any] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    is_finished: bool = False


def read_run(path: Path) -> OfflineRun:
    """Return the run that is in a file ``*.wandb``."""
    from wandb.proto import wandb_internal_pb2

    run = OfflineRun()
    for data in _records(path.read_bytes()):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        kind = record.WhichOneof("record_type")
        if kind == "run":
            run.name, run.project = record.run.display_name, record.run.project
            run.config |= _values(record.run.config.update)
        elif kind == "history":
            run.history.append(_values(record.history.item))
        elif kind == "summary":
            run.summary |= _values(record.summary.update)
        elif kind == "exit":
            run.is_finished = record.exit.exit_code == 0
    return run


def _values(items: Any) -> dict[str, Any]:
    return {item.key or item.nested_key[0]: json.loads(item.value_json) for item in items}


def _records(data: bytes) -> Iterator[bytes]:
    assert data.startswith(b":W&B")
    place, parts = _HEAD, b""
    while place < len(data):
        left = _BLOCK - place % _BLOCK
        if left < _HEAD:
            place += left
            continue
        _, length, kind = struct.unpack("<IHB", data[place : place + _HEAD])
        parts += data[place + _HEAD : place + _HEAD + length]
        place += _HEAD + length
        if kind in (_WHOLE, _LAST):
            yield parts
            parts = b""


def test_wandb_reads_every_run(results: Path, tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    from studies.trackers.wandb_runs import write_runs

    write_runs(results, tmp_path / "out")
    found: dict[str, OfflineRun] = {}
    for path in (tmp_path / "out").glob("wandb/offline-run-*/run-*.wandb"):
        run = read_run(path)
        found[run.config["key"]] = run
    assert set(found) == set(RESULTS)
    for spec in SPECS:
        run, result = found[spec.trial_key], RESULTS[spec.trial_key]
        assert (run.project, run.is_finished, run.config["seed"]) == ("dopt", True, spec.seed)
        assert json.dumps(run.config["env"]["name"]) == json.dumps(spec.system.name)
        assert [row["_step"] for row in run.history] == list(range(result.n_steps))
        np.testing.assert_array_equal([row["loss"] for row in run.history], losses(spec))
        for row in result.assessments:
            if np.isfinite(row.value):
                assert run.summary[f"{row.measure}/{row.t}"] == row.value
