"""Check of a SQLite file: damaged pages and dangling references."""

from __future__ import annotations

from orchestrate.store.doctor.findings import REBUILD, Finding, found
from orchestrate.store.read.reader import Reader

RESTORE = (
    "restore a copy from before the damage; without one, save what can be read with "
    "sqlite3 DATABASE .recover, and run the same launch again"
)
_MAX_REPORTED = 20


def damaged_pages(moment: Reader) -> list[Finding]:
    """Run SQLite's integrity check."""
    lines = [row[0] for row in moment.rows(f"PRAGMA integrity_check({_MAX_REPORTED})")]
    if lines == ["ok"]:
        return []
    first = " ".join(str(lines[0]).split())
    return [found("error", "damaged places in the file, or more", len(lines), first, RESTORE)]


def dangling_references(moment: Reader) -> list[Finding]:
    """Run SQLite's foreign key check."""
    rows = moment.rows("PRAGMA foreign_key_check")
    if not rows:
        return []
    tables = ", ".join(sorted({str(row[0]) for row in rows}))
    sentence = f"rows that refer to missing rows: {len(rows):,}, in {tables}"
    return [Finding("error", sentence, len(rows), REBUILD)]
