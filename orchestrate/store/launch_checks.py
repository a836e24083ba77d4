"""Launches and what they hold on to: claims and lock files."""

from __future__ import annotations

from pathlib import Path

from orchestrate.store.findings import Finding, found
from orchestrate.store.reader import Reader

_NEXT_LAUNCH = "nothing: the next launch takes care of it"


def dead_launches(moment: Reader) -> list[Finding]:
    """Find launches that say that they run and do not, and the trials that they hold."""
    rows = moment.launches()
    dead = {row.launch_id for row in rows if row.state == "running" and not row.alive}
    over = {row.launch_id for row in rows if row.state != "running"}
    owners = [row[0] for row in moment.rows("SELECT owner FROM trial WHERE status = 'running'")]
    held = sum(owner in dead or owner in over for owner in owners)
    findings = []
    if dead:
        what = "launches that say that they run and do not"
        findings.append(found("note", what, len(dead), f"launch {min(dead)}", _NEXT_LAUNCH))
    if held:
        what = f"trials held by launches that do not run: {held:,}"
        findings.append(Finding("note", what, held, _NEXT_LAUNCH))
    return findings


def leftover_files(moment: Reader, path: Path) -> list[Finding]:
    """Find lock files of launches that do not run, and backups that were not finished."""
    folder = path.with_name(f"{path.name}-locks")
    tokens = {row[0] for row in moment.rows("SELECT token FROM launch WHERE state = 'running'")}
    files = sorted(folder.glob("launch-*"))
    files = [file for file in files if file.name.removeprefix("launch-") not in tokens]
    files += sorted(path.parent.glob(f"{path.name}.*-backup*.partial"))
    if not files:
        return []
    advice = "delete them while no launch is starting"
    return [found("note", "files left over by launches or backups", len(files), files[0], advice)]
