"""Tracking store of MLflow: a SQLite database with an experiment for each system."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrate.export.trackers import runs
from orchestrate.export.trackers.runs import TrackedRun
from orchestrate.export.wanted import FolderExport
from orchestrate.files import whole_folder
from orchestrate.store import ConfigRow, Reader

if TYPE_CHECKING:
    from mlflow import MlflowClient

DATABASE = "mlflow.db"

_PACKAGE = "mlflow-skinny"
_METRICS_AT_ONCE = 1000
"""Most metrics that a call of the client takes."""

_NO_TELEMETRY = "MLFLOW_DISABLE_TELEMETRY"


def write_mlflow(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport
) -> dict[str, Any]:
    """Write ``mlflow.db``, whole or not at all; return what ``provenance.json`` says.

    Each finished trial is a run: its configuration as parameters; key, seed, status and commit as
    tags; losses and assessments as metrics with steps. Raises ``ExportError``.
    """
    runs.check_finished(reader, configs)
    with whole_folder(wanted.out, lambda path: runs.is_export_of("mlflow", path)) as folder:
        with _client(folder / DATABASE) as client:
            experiments = {
                env: client.create_experiment(env, (wanted.out.absolute() / "artifacts").as_uri())
                for env in sorted({config.env for config in configs})
            }
            for run in runs.tracked_runs(reader, configs):
                _log(client, experiments[run.env], run)
        facts = runs.write_provenance(reader, configs, wanted, _PACKAGE, folder)
        return facts | {"bytes": runs.size_of(folder)}


@contextmanager
def _client(database: Path) -> Iterator[MlflowClient]:
    """Open a new store without messages of its migrations, and without reports to MLflow."""
    os.environ.setdefault(_NO_TELEMETRY, "true")
    try:
        from mlflow import MlflowClient
    except ImportError as error:
        raise runs.missing_library("mlflow", _PACKAGE) from error
    before = logging.root.manager.disable
    logging.disable(logging.INFO)  # not the levels of its loggers, which its migrations set anew
    try:
        yield MlflowClient(tracking_uri=f"sqlite:///{database}")
    finally:
        logging.disable(before)


def _log(client: MlflowClient, experiment: str, run: TrackedRun) -> None:
    from mlflow.entities import Metric, Param

    began, ended = _milliseconds(run.started), _milliseconds(run.ended)
    tags = dict(run.tags)
    if "git_commit" in tags:
        tags["mlflow.source.git.commit"] = tags["git_commit"]
    created = client.create_run(experiment, start_time=began, tags=tags, run_name=run.name)
    run_id = created.info.run_id
    client.log_batch(run_id, params=[Param(*one) for one in runs.flat(run.settings).items()])
    rows = [(name, value, t) for name, curve in run.curves.items() for t, value in curve]
    rows += [(name, value, t) for t, name, value in run.assessments]
    rows += [(name, value, 0) for name, value in run.summary.items()]
    metrics = [Metric(name, value, ended or began or 0, t) for name, value, t in rows]
    for first in range(0, len(metrics), _METRICS_AT_ONCE):
        client.log_batch(run_id, metrics=metrics[first : first + _METRICS_AT_ONCE])
    client.set_terminated(run_id, "FINISHED", end_time=ended)


def _milliseconds(moment: datetime | None) -> int | None:
    return None if moment is None else round(1000 * moment.timestamp())
