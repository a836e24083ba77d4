"""Everything about a database that can be wrong, looked for and never touched."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from orchestrate.store import address
from orchestrate.store.curve_checks import broken_curves
from orchestrate.store.errors import StoreUnavailableError
from orchestrate.store.findings import Finding, found
from orchestrate.store.key_checks import TrialKey, unpaired_seeds, wrong_keys
from orchestrate.store.launch_checks import dead_launches, leftover_files
from orchestrate.store.reader import Reader
from orchestrate.store.row_checks import CHECKS, REBUILD

_ORDER = ("error", "warning", "note")
_SHOWN = 20
_RESTORE = (
    "restore a copy from before the damage; without one, save what can be read with "
    "sqlite3 DATABASE .recover, and run the same launch again"
)

Look = Callable[[], list[Finding]]


def examine(url: str, trial_key: TrialKey | None = None) -> list[Finding]:
    """Return what is wrong with a database, the worst first; nothing is written.

    Parameters
    ----------
    url
        SQLite or PostgreSQL. Bits that flipped within a number of a SQLite file cannot be seen.
    trial_key
        Computes the key of a trial from the JSON of its configuration and its seed; without it the
        keys of trials are not checked.

    Raises
    ------
    StoreError
        As :meth:`Reader.open` does; damage to the file is a finding where it can still be opened.
    """
    parsed = address.parse(url)
    path = address.sqlite_path(parsed) if parsed.get_backend_name() == "sqlite" else None
    findings: list[Finding] = []
    try:
        with Reader.open(url) as reader, reader.moment() as moment:
            for look in _looks(moment, path, trial_key):
                with _damage_found(findings, path):
                    findings += look()
    except StoreUnavailableError:
        # After damage SQLite may not even end the transaction; what was found is worth more.
        if not any(one.severity == "error" for one in findings):
            raise
    return sorted(dict.fromkeys(findings), key=lambda one: _ORDER.index(one.severity))


def _looks(moment: Reader, path: Path | None, trial_key: TrialKey | None) -> Iterator[Look]:
    if path is not None:
        yield partial(_damaged_pages, moment)
        yield partial(_dangling_references, moment)
    yield partial(broken_curves, moment)
    for check in CHECKS:
        yield partial(check.findings, moment)
    yield partial(wrong_keys, moment, trial_key)
    yield partial(unpaired_seeds, moment)
    yield partial(dead_launches, moment)
    if path is not None:
        yield partial(leftover_files, moment, path)


@contextmanager
def _damage_found(findings: list[Finding], path: Path | None) -> Iterator[None]:
    """Go on with the next look where this one met a damaged page; a server's error ends it all."""
    try:
        yield
    except StoreUnavailableError as error:
        if path is None or error.transient:
            raise
        findings.append(Finding("error", str(error).rstrip("."), 1, _RESTORE))


def _damaged_pages(moment: Reader) -> list[Finding]:
    lines = [row[0] for row in moment.rows(f"PRAGMA integrity_check({_SHOWN})")]
    if lines == ["ok"]:
        return []
    first = " ".join(str(lines[0]).split())
    return [found("error", "damaged places in the file, or more", len(lines), first, _RESTORE)]


def _dangling_references(moment: Reader) -> list[Finding]:
    rows = moment.rows("PRAGMA foreign_key_check")
    if not rows:
        return []
    tables = ", ".join(sorted({str(row[0]) for row in rows}))
    sentence = f"rows that refer to rows that are not there: {len(rows):,}, in {tables}"
    return [Finding("error", sentence, len(rows), REBUILD)]
