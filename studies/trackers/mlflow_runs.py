"""Finished trials of a SQLite database as runs of MLflow.

    python studies/trackers/mlflow_runs.py RESULTS DATABASE

needs the packages mlflow-skinny, alembic and sqlalchemy. Each system is an experiment; a run has
the configuration as parameters, and losses and assessments as metrics with steps. Read it with
``mlflow ui --backend-store-uri sqlite:///DATABASE``.
"""

from __future__ import annotations

import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
from mlflow import MlflowClient
from mlflow.entities import Metric, Param

CALL = 1000
"""Most metrics that a call of the client takes."""

RESULTS = ["final_loss", "best_loss", "wall_seconds", "cpu_seconds", "peak_memory_bytes"]


def write_runs(results: Path, database: Path) -> None:
    """Write every done and diverged trial of a database into a tracking store."""
    with closing(sqlite3.connect(f"file:{results}?mode=ro", uri=True)) as source:
        tables = ("config", "trial", "step", "assessment")
        read = {name: pd.read_sql(f"SELECT * FROM {name}", source) for name in tables}
    trials = read["trial"].merge(read["config"], on="config_id")
    steps, assessed = (read[name].groupby("trial_id") for name in ("step", "assessment"))
    client, experiments = MlflowClient(tracking_uri=f"sqlite:///{database}"), dict[str, str]()
    trial: Any
    for trial in trials[trials.status.isin(["done", "diverged"])].itertuples():
        if trial.env not in experiments:
            experiments[trial.env] = client.create_experiment(trial.env)
        name = f"{trial.env}, {trial.label}, seed {trial.seed}"
        tags = {"trial_key": trial.trial_key, "status": trial.status, "label": trial.label}
        run = client.create_run(experiments[trial.env], tags=tags, run_name=name).info.run_id
        settings = pd.json_normalize(json.loads(trial.config_json) | {"seed": trial.seed}).iloc[0]
        client.log_batch(run, params=[Param(str(key), str(one)) for key, one in settings.items()])
        rows = [(one, getattr(trial, one), 0) for one in RESULTS]
        for name in ("loss", "reachable_loss"):
            own = steps.get_group(trial.trial_id)
            rows += [(name, *row) for row in zip(own[name], own["t"], strict=True)]
        if trial.trial_id in assessed.groups:
            own = assessed.get_group(trial.trial_id)
            rows += list(zip(own.measure, own.value, own["t"], strict=True))
        metrics = [Metric(one, float(v), 0, int(t)) for one, v, t in rows if pd.notna(v)]
        for first in range(0, len(metrics), CALL):
            client.log_batch(run, metrics=metrics[first : first + CALL])
        client.set_terminated(run, "FINISHED")


if __name__ == "__main__":
    write_runs(Path(sys.argv[1]), Path(sys.argv[2]).absolute())
