"""Finished trials as runs of a tracker: settings, tags, curves and summary."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from dopt.errors import install_command
from orchestrate.export.columns import STEP_COLUMNS
from orchestrate.export.manifest import provenance
from orchestrate.export.streams import steps
from orchestrate.export.wanted import ExportError, FolderExport
from orchestrate.store import ConfigRow, LaunchRow, Reader, TrialRow

PROVENANCE = "provenance.json"
CURVES = ("loss", "reachable_loss")

_SUMMARY = ("final_loss", "best_loss", "wall_seconds", "cpu_seconds", "peak_memory_bytes")
_TIMES = (
    "SELECT a.started, a.ended FROM attempt a JOIN trial r ON r.trial_id = a.trial_id "
    "WHERE r.trial_key = :trial_key AND a.attempt = r.attempt"
)


@dataclass(frozen=True)
class TrackedRun:
    """Finished trial.

    Attributes
    ----------
    name
        Label of the configuration, and seed.
    settings
        The configuration, nested, with the seed.
    tags
        Key, seed, status, host and commit as text.
    curves
        (t, value) of each of ``CURVES``, as far as the values are finite.
    summary
        Losses and cost; those that the trial has.
    assessments
        (t, measure, value), as far as the values are finite.
    started, ended
        Times of the run; None where they are not stored.
    """

    key: str
    env: str
    name: str
    settings: Mapping[str, Any]
    tags: Mapping[str, str]
    curves: Mapping[str, Sequence[tuple[int, float]]]
    summary: Mapping[str, float]
    assessments: Sequence[tuple[int, str, float]]
    started: datetime | None
    ended: datetime | None


def tracked_runs(reader: Reader, configs: Sequence[ConfigRow]) -> Iterator[TrackedRun]:
    """Yield the done and diverged trials, by configuration and seed."""
    launches = {launch.launch_id: launch for launch in reader.launches()}
    for config in configs:
        trials = {trial.seed: trial for trial in reader.trials(config.config_key)}
        assessments = _assessments(reader, config)
        for seed, curves in _curves(reader, config):
            trial = trials[seed]
            launch = None if trial.launch is None else launches[trial.launch]
            started, ended = _times(reader, trial)
            yield TrackedRun(
                key=trial.trial_key,
                env=config.env,
                name=f"{config.env}, {config.label}, seed {seed}",
                settings={**config.config, "seed": seed},
                tags=_tags(config, trial, launch),
                curves=curves,
                summary=_summary(trial),
                assessments=assessments.get(seed, ()),
                started=started,
                ended=ended,
            )


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings by dotted path, as text: a text as it is, other values as JSON."""
    found: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value if isinstance(value, str) else json.dumps(value)
    return found


def check_finished(reader: Reader, configs: Sequence[ConfigRow]) -> None:
    """Raise ``ExportError`` if no trial is finished."""
    if not any(config.n_done + config.n_diverged for config in configs):
        raise ExportError(
            f"No trial of these in {reader.safe_url} is done yet, so that there are no runs to "
            "export: run the launch, or see status."
        )


def missing_library(kind: str, package: str) -> ExportError:
    """Return the error of an export whose library is not installed."""
    return ExportError(
        f"The export {kind} needs the package {package}, which is not installed: run "
        f"{install_command(kind)}."
    )


def write_provenance(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport, package: str, folder: Path
) -> dict[str, Any]:
    """Write where the runs of a folder come from; return it with the number of runs."""
    facts = {
        "kind": wanted.kind,
        "library": f"{package} {metadata.version(package)}",
        "n_trials": sum(config.n_done + config.n_diverged for config in configs),
        **provenance(reader, configs, wanted.filters),
        "missing_values": "left out: a loss that is not finite",
    }
    (folder / PROVENANCE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return facts


def is_export_of(kind: str, folder: Path) -> bool:
    """Return whether the folder is an earlier export of the kind."""
    try:
        facts = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(facts, dict) and facts.get("kind") == kind


def size_of(folder: Path) -> int:
    """Return the bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _curves(
    reader: Reader, config: ConfigRow
) -> Iterator[tuple[int, dict[str, list[tuple[int, float]]]]]:
    places = {name: 3 + STEP_COLUMNS.index(name) for name in CURVES}  # after seed, status and t
    with closing(steps(reader, config)) as batches:
        rows = (row for batch in batches for row in batch)
        for seed, own in groupby(rows, key=itemgetter(0)):
            found: dict[str, list[tuple[int, float]]] = {name: [] for name in CURVES}
            for row in own:
                for name, place in places.items():
                    if row[place] is not None:
                        found[name].append((row[2], row[place]))
            yield seed, found


def _assessments(reader: Reader, config: ConfigRow) -> dict[int, list[tuple[int, str, float]]]:
    rows = reader.rows(
        "SELECT seed, t, measure, value FROM v_assessment WHERE config_key = :key "
        "AND value IS NOT NULL ORDER BY seed, t, measure",
        key=config.config_key,
    )
    found: dict[int, list[tuple[int, str, float]]] = {}
    for seed, t, measure, value in rows:
        found.setdefault(seed, []).append((t, measure, value))
    return found


def _times(reader: Reader, trial: TrialRow) -> tuple[datetime | None, datetime | None]:
    rows = reader.rows(_TIMES, trial_key=trial.trial_key)
    started, ended = rows[0] if rows else (None, None)
    return _moment(started), _moment(ended)


def _moment(text: str | None) -> datetime | None:
    return None if text is None else datetime.fromisoformat(text)


def _summary(trial: TrialRow) -> dict[str, float]:
    values = {name: getattr(trial, name) for name in _SUMMARY}
    return {name: float(value) for name, value in values.items() if value is not None}


def _tags(config: ConfigRow, trial: TrialRow, launch: LaunchRow | None) -> dict[str, str]:
    tags: dict[str, object] = {
        "trial_key": trial.trial_key,
        "config_key": config.config_key,
        "env": config.env,
        "policy": config.policy,
        "label": config.label,
        "seed": trial.seed,
        "status": trial.status,
        "diverged_at": trial.diverged_at,
        "node": trial.node,
    }
    if launch is not None:
        tags |= {"git_commit": launch.git_commit, "git_dirty": launch.git_dirty}
    return {name: str(value) for name, value in tags.items() if value is not None}
