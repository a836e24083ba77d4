"""Offline runs of Weights & Biases, which ``wandb sync`` uploads."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrate.export.trackers import runs
from orchestrate.export.trackers.runs import TrackedRun
from orchestrate.export.wanted import FolderExport
from orchestrate.files import whole_folder
from orchestrate.store import ConfigRow, Reader

if TYPE_CHECKING:
    import wandb

PROJECT = "dopt"
_PACKAGE = "wandb"
_KEY_DIGITS = 32
"""Digits of the trial key in the identifier of a run."""


def write_wandb(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport
) -> dict[str, Any]:
    """Write a folder ``wandb``, whole or not at all; return what ``provenance.json`` says.

    Each finished trial is a run of the project ``dopt``: its configuration, with key, seed and
    commit; losses by step; final losses, cost and assessments as summary. Raises ``ExportError``.
    """
    runs.check_finished(reader, configs)
    try:
        import wandb
    except ImportError as error:
        raise runs.missing_library("wandb", _PACKAGE) from error
    with whole_folder(wanted.out, lambda path: runs.is_export_of("wandb", path)) as folder:
        settings = _settings(folder)
        try:
            for run in runs.tracked_runs(reader, configs):
                _log(run, settings)
        finally:
            wandb.teardown()  # the process that writes the files
        _remove_logs(folder / "wandb")
        facts = runs.write_provenance(reader, configs, wanted, _PACKAGE, folder)
        return facts | {"bytes": runs.size_of(folder)}


def _settings(folder: Path) -> wandb.Settings:
    """Return settings under which nothing of this process, host or repository is recorded."""
    import wandb

    return wandb.Settings(
        mode="offline",
        root_dir=str(folder),
        project=PROJECT,
        console="off",
        silent=True,
        disable_git=True,
        disable_code=True,
        x_disable_meta=True,
        x_disable_stats=True,
        x_save_requirements=False,
    )


def _log(run: TrackedRun, settings: wandb.Settings) -> None:
    import wandb

    tracked = wandb.init(
        id=run.key[:_KEY_DIGITS],
        name=run.name,
        group=run.tags["label"],
        job_type=run.env,
        config={**run.settings, "trial": dict(run.tags)},
        settings=settings,
    )
    names = list(run.curves)
    values: dict[int, dict[str, float]] = {}
    for name in names:
        for t, value in run.curves[name]:
            values.setdefault(t, {})[name] = value
    for t in sorted(values):
        tracked.log(values[t], step=t)
    tracked.summary.update({**run.summary, **_measures(run)})
    tracked.finish()


def _remove_logs(folder: Path) -> None:
    """Remove logs of this process, which name its folders, and links to the last run."""
    for path in folder.iterdir():
        if path.is_symlink():
            path.unlink()
        elif path.is_dir():
            shutil.rmtree(path / "logs", ignore_errors=True)


def _measures(run: TrackedRun) -> dict[str, float]:
    """Return the assessments by measure and number of explored steps."""
    return {f"{measure}/{t}": value for t, measure, value in run.assessments}
