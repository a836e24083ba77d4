"""Finished trials of a SQLite database as offline runs of Weights & Biases.

    python studies/trackers/wandb_runs.py RESULTS FOLDER

needs the package wandb. A run has the configuration, losses by step, and final losses and
assessments as summary. ``wandb sync FOLDER/wandb/offline-run-*`` uploads the runs.
"""

from __future__ import annotations

import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
import wandb

LOSSES = ["loss", "reachable_loss"]
RESULTS = ["final_loss", "best_loss", "wall_seconds", "cpu_seconds", "peak_memory_bytes"]


def write_runs(results: Path, folder: Path) -> None:
    """Write every done and diverged trial of a database as an offline run into a folder."""
    with closing(sqlite3.connect(f"file:{results}?mode=ro", uri=True)) as source:
        tables = ("config", "trial", "step", "assessment")
        read = {name: pd.read_sql(f"SELECT * FROM {name}", source) for name in tables}
    trials = read["trial"].merge(read["config"], on="config_id")
    steps, assessed = (read[name].groupby("trial_id") for name in ("step", "assessment"))
    # Nothing of this process, host or repository is recorded.
    settings = wandb.Settings(
        mode="offline", root_dir=str(folder), project="dopt", console="off", silent=True,
        disable_git=True, disable_code=True, x_disable_meta=True, x_disable_stats=True,
        x_save_requirements=False,
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    trial: Any
    for trial in trials[trials.status.isin(["done", "diverged"])].itertuples():
        run = wandb.init(
            id=trial.trial_key[:32],
            name=f"{trial.env}, {trial.label}, seed {trial.seed}",
            group=trial.label,
            job_type=trial.env,
            config={**json.loads(trial.config_json), "seed": trial.seed, "key": trial.trial_key},
            settings=settings,
        )
        for row in steps.get_group(trial.trial_id).sort_values("t").to_dict("records"):
            if values := {one: row[one] for one in LOSSES if pd.notna(row[one])}:
                run.log(values, step=row["t"])
        summary = {one: getattr(trial, one) for one in RESULTS}
        if trial.trial_id in assessed.groups:
            own = assessed.get_group(trial.trial_id)
            summary |= {f"{row.measure}/{row.t}": row.value for row in own.itertuples()}
        run.summary.update({one: float(v) for one, v in summary.items() if pd.notna(v)})
        run.finish()
    wandb.teardown()


if __name__ == "__main__":
    write_runs(Path(sys.argv[1]), Path(sys.argv[2]).absolute())
