"""Check of keys: each one is the hash of its configuration and seed."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from orchestrate.store.doctor.findings import Finding, found
from orchestrate.store.read.reader import Reader

TrialKey = Callable[[str, int], str]
"""Function from the JSON of a configuration and a seed to the key of the trial."""

_CONFIGS = "SELECT config_id, config_key, config_json FROM config ORDER BY config_id"
_KEYS = "SELECT config_id, seed, trial_key FROM trial ORDER BY trial_id"
_BATCH_ROWS = 10_000


def wrong_keys(moment: Reader, trial_key: TrialKey | None) -> list[Finding]:
    """Compare every key with a new hash; keys of trials only if ``trial_key`` is given."""
    configs = {row[0]: (row[1], row[2]) for row in moment.rows(_CONFIGS)}
    wrong = [key for key, text in configs.values() if _digest(text) != key]
    findings = _mismatch("configurations", wrong)
    if trial_key is None:
        return findings
    wrong = [
        key
        for rows in moment.batches(_BATCH_ROWS, _KEYS)
        for config_id, seed, key in rows
        if trial_key(configs[config_id][1], seed) != key
    ]
    return findings + _mismatch("trials", wrong)


def _mismatch(what: str, keys: list[str]) -> list[Finding]:
    if not keys:
        return []
    what = f"{what} whose key does not match their content"
    advice = "they were changed: restore an older copy, or run them again in a new database"
    return [found("error", what, len(keys), keys[0][:12], advice)]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
