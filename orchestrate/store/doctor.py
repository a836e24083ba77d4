"""Examination of a results database without changing it: what is wrong, and what to do about it.

The checks are: damage to a SQLite file, incomplete results, damaged arrays of packed curves, keys
that do not match their content, results of different code, and claims of dead launches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

from orchestrate.errors import StoreUnavailableError
from orchestrate.store import records
from orchestrate.store.backends.base import parse_url
from orchestrate.store.reader import Reader
from orchestrate.store.schema import N_ROWS, PREQUENTIAL, SAMPLE_LOSS, STEP_VALUES

Severity = Literal["error", "note"]
_ORDER = ("error", "note")

TrialKey = Callable[[str, int], str]
"""Function from the JSON of a configuration and a seed to the key of the trial."""

_MAX_REPORTED = 20

_REBUILD = (
    "merge this database into a new one, which leaves such trials out (python -m orchestrate merge "
    "THIS --db NEW), and run the same launch into that one"
)
_RESTORE = (
    "restore a copy from before the damage; without one, save what can be read with "
    "sqlite3 DATABASE .recover, and run the same launch again"
)
_NEXT_LAUNCH = "nothing to do: the next launch releases them"
_ONE_CODE = (
    "compare their numbers with care, or prune the trials of one of the two (launch_id of v_trial) "
    "and give their launch command again"
)
_MISMATCH = "whose key does not match their content"
_PACK_AGAIN = "delete all rows of the table curve and run 'python -m orchestrate upgrade'"
_RUN_AGAIN = "they were changed: restore an older copy, or run them again in a new database"


@dataclass(frozen=True)
class Finding:
    """Result of a consistency check.

    Attributes
    ----------
    severity
        "error" if results cannot be trusted, "note" if nothing is lost.
    sentence
        Description.
    count
        Number of occurrences.
    advice
        Remedy.
    """

    severity: Severity
    sentence: str
    count: int
    advice: str


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
    parsed = parse_url(url)
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


def _checks(
    moment: Reader, is_file: bool, trial_key: TrialKey | None
) -> Iterator[Callable[[], list[Finding]]]:
    if is_file:
        yield partial(_damaged_pages, moment)
        yield partial(_dangling_references, moment)
    yield partial(_incomplete_results, moment)
    yield partial(_damaged_curves, moment)
    yield partial(_wrong_keys, moment, trial_key)
    yield partial(_mixed_code, moment)
    yield partial(_dead_launches, moment)


@contextmanager
def _damage_recorded(findings: list[Finding], is_file: bool) -> Iterator[None]:
    """Record a damaged page as a finding; the error of a server ends the examination."""
    try:
        yield
    except StoreUnavailableError as error:
        if not is_file or error.transient:
            raise
        findings.append(Finding("error", str(error).rstrip("."), 1, _RESTORE))


def _several(severity: Severity, what: str, names: Sequence[object], advice: str) -> list[Finding]:
    """Return a finding of several objects of a kind, with the name of the first; none of none."""
    if not names:
        return []
    sentence = f"{what}: {len(names):,} (the first is {names[0]})"
    return [Finding(severity, sentence, len(names), advice)]


def _damaged_pages(moment: Reader) -> list[Finding]:
    """Run SQLite's integrity check."""
    rows = moment.rows(f"PRAGMA integrity_check({_MAX_REPORTED})")
    lines = [" ".join(str(row[0]).split()) for row in rows]
    damaged = [] if lines == ["ok"] else lines
    return _several("error", "damaged places in the file, or more", damaged, _RESTORE)


def _dangling_references(moment: Reader) -> list[Finding]:
    """Run SQLite's foreign key check."""
    rows = moment.rows("PRAGMA foreign_key_check")
    if not rows:
        return []
    tables = ", ".join(sorted({str(row[0]) for row in rows}))
    sentence = f"rows that refer to missing rows: {len(rows):,}, in {tables}"
    return [Finding("error", sentence, len(rows), _REBUILD)]


def _damaged_curves(moment: Reader) -> list[Finding]:
    """Unpack every array of the packed curves."""
    damaged = [
        f"trial_id {trial_id}"
        for rows in moment.batches(
            1_000, f"SELECT trial_id, {', '.join(STEP_VALUES)} FROM curve ORDER BY trial_id"
        )
        for trial_id, *arrays in rows
        if any(not len(records.unpacked_curve(one)) for one in arrays)
    ]
    return _several("error", "trials with a packed curve that is damaged", damaged, _PACK_AGAIN)


def _wrong_keys(moment: Reader, trial_key: TrialKey | None) -> list[Finding]:
    """Compare every key with a new hash; keys of trials only if ``trial_key`` is given."""
    rows = moment.rows("SELECT config_id, config_key, config_json FROM config ORDER BY config_id")
    texts = {config_id: text for config_id, _, text in rows}
    wrong = [key for _, key, text in rows if hashlib.sha256(text.encode()).hexdigest() != key]
    findings = _several("error", f"configurations {_MISMATCH}", [*map(_brief, wrong)], _RUN_AGAIN)
    if trial_key is None:
        return findings
    trials = moment.batches(
        10_000, "SELECT config_id, seed, trial_key FROM trial ORDER BY trial_id"
    )
    wrong = [
        key
        for batch in trials
        for config_id, seed, key in batch
        if trial_key(texts[config_id], seed) != key
    ]
    return findings + _several("error", f"trials {_MISMATCH}", [*map(_brief, wrong)], _RUN_AGAIN)


def _brief(key: str) -> str:
    return key[:12]


def _mixed_code(moment: Reader) -> list[Finding]:
    """Find the configurations whose finished trials were run by different code."""
    what = "configurations with results of code or libraries with different fingerprints"
    return _several("note", what, [*map(_brief, moment.mixed_code())], _ONE_CODE)


def _dead_launches(moment: Reader) -> list[Finding]:
    """Find the launches that are recorded as running but are dead, and the trials they hold."""
    rows = moment.launches()
    dead = sorted(row.launch_id for row in rows if row.state == "running" and not row.alive)
    over = {row.launch_id for row in rows if row.state != "running"} | set(dead)
    owners = [row[0] for row in moment.rows("SELECT owner FROM trial WHERE status = 'running'")]
    held = sum(owner is None or owner in over for owner in owners)
    what = "launches recorded as running whose process is gone"
    findings = _several("note", what, [f"launch {one}" for one in dead], _NEXT_LAUNCH)
    if held:
        what = f"trials held by launches that do not run: {held:,}"
        findings.append(Finding("note", what, held, _NEXT_LAUNCH))
    return findings


_NAME = (
    "c.env || ' ' || c.policy || ' seed ' || r.seed || ' (' || substr(r.trial_key, 1, 12) || ')'"
)
_FINISHED = "r.status IN ('done', 'diverged')"
_END = f"coalesce(r.diverged_at, {N_ROWS})"  # the first step without a loss
_LARGEST = "1.7976931348623157e308"  # NaN is larger in PostgreSQL, and NULL in SQLite


def _not_finite(table: str, *columns: str) -> str:
    return " OR ".join(f"abs({table}.{column}) > {_LARGEST}" for column in columns)


_CONDITIONS = {
    "finished trials without one step for each t below their horizon": (
        f"{_FINISHED} AND (s.n IS NULL OR s.n <> {N_ROWS} OR s.low <> 0 OR s.high <> {N_ROWS} - 1)"
    ),
    "finished trials that lack a loss before they diverged or ended, or have one after that": (
        f"{_FINISHED} AND (s.n_loss <> {_END} OR s.last >= {_END})"
    ),
    "done trials whose final loss differs from the loss of their last step": (
        "r.status = 'done' AND (r.final_loss IS NULL OR r.final_loss <> e.loss)"
    ),
    "finished trials without a trajectory": f"{_FINISHED} AND p.trial_id IS NULL",
    "done trials that lack assessments": (
        f"r.status = 'done' AND c.config_json NOT LIKE '{PREQUENTIAL}' "
        "AND (coalesce(a.n, 0) <> coalesce(m.most, 0) "
        """OR (coalesce(a.n, 0) = 0 AND (c.config_json LIKE '%"task":{%' """
        """OR c.config_json LIKE '%"limits":{%')))"""
    ),
    "unfinished trials with steps, a trajectory or assessments": (
        f"NOT {_FINISHED} AND (s.n > 0 OR p.trial_id IS NOT NULL OR a.trial_id IS NOT NULL)"
    ),
    "trials with a number that is not finite, where NULL is expected": (
        f"s.infinite > 0 OR a.infinite > 0 OR {_not_finite('r', 'final_loss', 'best_loss')}"
    ),
}
_FLAGS = [
    f"CASE WHEN {condition} THEN 1 ELSE 0 END AS flag_{i}"
    for i, condition in enumerate(_CONDITIONS.values())
]
_SUM = " + ".join(f"flag_{i}" for i in range(len(_FLAGS)))
_STEPS = f"""
SELECT trial_id, count(*) AS n, min(t) AS low, max(t) AS high, count(loss) AS n_loss,
       max(CASE WHEN loss IS NOT NULL THEN t END) AS last,
       sum(CASE WHEN {_not_finite("s", *STEP_VALUES)} THEN 1 ELSE 0 END) AS infinite
FROM step s GROUP BY trial_id
"""
_ASSESSMENTS = f"""
SELECT trial_id, count(*) FILTER (WHERE measure <> '{SAMPLE_LOSS}') AS n,
       sum(CASE WHEN {_not_finite("a", "value")} THEN 1 ELSE 0 END) AS infinite
FROM assessment a GROUP BY trial_id
"""
_EXPECTED_ASSESSMENTS = f"""
SELECT o.config_id, max(n) AS most
FROM (SELECT trial_id, count(*) AS n FROM assessment WHERE measure <> '{SAMPLE_LOSS}'
      GROUP BY trial_id) counted
JOIN trial o ON o.trial_id = counted.trial_id WHERE o.status = 'done' GROUP BY o.config_id
"""
_SQL = f"""
SELECT * FROM (
    SELECT r.trial_id, {_NAME} AS name, {", ".join(_FLAGS)}
    FROM trial r
    JOIN config c ON c.config_id = r.config_id
    LEFT JOIN ({_STEPS}) s ON s.trial_id = r.trial_id
    LEFT JOIN step e ON e.trial_id = r.trial_id AND e.t = {N_ROWS} - 1
    LEFT JOIN trajectory p ON p.trial_id = r.trial_id
    LEFT JOIN ({_ASSESSMENTS}) a ON a.trial_id = r.trial_id
    LEFT JOIN ({_EXPECTED_ASSESSMENTS}) m ON m.config_id = r.config_id) AS flagged
WHERE {_SUM} > 0 ORDER BY trial_id
"""


def _incomplete_results(moment: Reader) -> list[Finding]:
    """Look for finished trials that lack rows, and for others that have some."""
    rows = moment.rows(_SQL)
    findings = []
    for column, condition in enumerate(_CONDITIONS, start=2):
        names = [row[1] for row in rows if row[column]]
        findings += _several("error", condition, names, _REBUILD)
    return findings
