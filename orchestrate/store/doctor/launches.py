"""Check of launches: dead ones, the trials that they still hold, and results of different code."""

from __future__ import annotations

from orchestrate.store.doctor.findings import Finding, found
from orchestrate.store.read.reader import Reader

_NEXT_LAUNCH = "nothing to do: the next launch releases them"


_ONE_CODE = (
    "compare their numbers with care, or prune the trials of one of the two (launch_id of v_trial) "
    "and give their launch command again"
)


def mixed_code(moment: Reader) -> list[Finding]:
    """Return a finding of the configurations whose finished trials were run by different code."""
    keys = moment.mixed_code()
    if not keys:
        return []
    what = "configurations with results of code or libraries with different fingerprints"
    return [found("note", what, len(keys), keys[0][:12], _ONE_CODE)]


def dead_launches(moment: Reader) -> list[Finding]:
    """Return the launches that are recorded as running but are dead, and the trials they hold."""
    rows = moment.launches()
    dead = {row.launch_id for row in rows if row.state == "running" and not row.alive}
    ended = {row.launch_id for row in rows if row.state != "running"}
    owners = [row[0] for row in moment.rows("SELECT owner FROM trial WHERE status = 'running'")]
    held = sum(owner is None or owner in dead | ended for owner in owners)
    findings = []
    if dead:
        what = "launches recorded as running whose process is gone"
        findings.append(found("note", what, len(dead), f"launch {min(dead)}", _NEXT_LAUNCH))
    if held:
        what = f"trials held by launches that do not run: {held:,}"
        findings.append(Finding("note", what, held, _NEXT_LAUNCH))
    return findings
