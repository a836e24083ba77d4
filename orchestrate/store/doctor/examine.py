"""Examination of a results database by six checks, without changing it.

The checks are: damage to a SQLite file, incomplete results, damaged arrays of packed curves, keys
that do not match their content, results of different code, and claims of dead launches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from orchestrate.store import database_url
from orchestrate.store.doctor.file_damage import RESTORE, damaged_pages, dangling_references
from orchestrate.store.doctor.findings import Finding
from orchestrate.store.doctor.keys import TrialKey, wrong_keys
from orchestrate.store.doctor.launches import dead_launches, mixed_code
from orchestrate.store.doctor.packed_curves import damaged_curves
from orchestrate.store.doctor.results import incomplete_results
from orchestrate.store.errors import StoreUnavailableError
from orchestrate.store.read.reader import Reader

_ORDER = ("error", "note")

Check = Callable[[], list[Finding]]


def examine(url: str, trial_key: TrialKey | None = None) -> list[Finding]:
    """Return the findings of all checks, errors first; nothing is written.

    Parameters
    ----------
    url
        SQLite or PostgreSQL. A changed bit within a number of a SQLite file cannot be detected.
    trial_key
        Computes the key of a trial from the JSON of its configuration and its seed; without it the
        keys of trials are not checked.

    Raises
    ------
    StoreError
        As :meth:`Reader.open` does; damage to a file that can still be opened is a finding.
    """
    parsed = database_url.parse(url)
    is_file = parsed.get_backend_name() == "sqlite"
    findings: list[Finding] = []
    try:
        with Reader.open(url) as reader, reader.moment() as moment:
            for check in _checks(moment, is_file, trial_key):
                with _damage_recorded(findings, is_file):
                    findings += check()
    except StoreUnavailableError:
        # After damage SQLite may not even end the transaction; the findings are kept.
        if not any(one.severity == "error" for one in findings):
            raise
    return sorted(dict.fromkeys(findings), key=lambda one: _ORDER.index(one.severity))


def _checks(moment: Reader, is_file: bool, trial_key: TrialKey | None) -> Iterator[Check]:
    if is_file:
        yield partial(damaged_pages, moment)
        yield partial(dangling_references, moment)
    yield partial(incomplete_results, moment)
    yield partial(damaged_curves, moment)
    yield partial(wrong_keys, moment, trial_key)
    yield partial(mixed_code, moment)
    yield partial(dead_launches, moment)


@contextmanager
def _damage_recorded(findings: list[Finding], is_file: bool) -> Iterator[None]:
    """Record a damaged page as a finding; the error of a server ends the examination."""
    try:
        yield
    except StoreUnavailableError as error:
        if not is_file or error.transient:
            raise
        findings.append(Finding("error", str(error).rstrip("."), 1, RESTORE))
