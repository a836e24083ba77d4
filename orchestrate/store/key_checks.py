"""Keys that are not those of what they stand for, and seeds that cannot be paired."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from orchestrate.store.findings import Finding, found
from orchestrate.store.reader import Reader

TrialKey = Callable[[str, int], str]
"""From the JSON of a configuration and a seed to the key of the trial."""

_CONFIGS = "SELECT config_id, config_key, config_json FROM config ORDER BY config_id"
_KEYS = "SELECT config_id, seed, trial_key FROM trial ORDER BY trial_id"
_RESULTS = (
    "SELECT c.env, c.width, c.horizon, c.dt, c.gamma, c.policy, c.config_key, r.seed FROM trial r "
    "JOIN config c ON c.config_id = r.config_id WHERE r.status IN ('done', 'diverged')"
)
_AT_ONCE = 10_000


def wrong_keys(moment: Reader, trial_key: TrialKey | None) -> list[Finding]:
    """Compute every key anew; those of trials only where ``trial_key`` says how."""
    configs = {row[0]: (row[1], row[2]) for row in moment.rows(_CONFIGS)}
    wrong = [key for key, text in configs.values() if _digest(text) != key]
    findings = _mismatch("configurations", wrong)
    if trial_key is None:
        return findings
    wrong = [
        key
        for rows in moment.batches(_AT_ONCE, _KEYS)
        for config_id, seed, key in rows
        if trial_key(configs[config_id][1], seed) != key
    ]
    return findings + _mismatch("trials", wrong)


def _mismatch(what: str, keys: list[str]) -> list[Finding]:
    if not keys:
        return []
    what = f"{what} whose key is not that of their content"
    advice = "somebody has changed them: restore a copy from before, or run them again elsewhere"
    return [found("error", what, len(keys), keys[0][:12], advice)]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def unpaired_seeds(moment: Reader) -> list[Finding]:
    """Find configurations of one system and width whose results are not of the same seeds."""
    groups: dict[tuple[Any, ...], dict[tuple[str, str], set[int]]]
    groups = defaultdict(lambda: defaultdict(set))
    for rows in moment.batches(_AT_ONCE, _RESULTS):
        for *group, policy, config_key, seed in rows:
            groups[tuple(group)][policy, config_key].add(seed)
    return [one for group, seeds in groups.items() for one in _unpaired(group, seeds)]


def _unpaired(group: tuple[Any, ...], seeds: dict[tuple[str, str], set[int]]) -> list[Finding]:
    shared = set.intersection(*seeds.values())
    alone = sum(len(one - shared) for one in seeds.values())
    if not alone:
        return []
    counts = ", ".join(f"{policy} {len(one):,}" for (policy, _), one in sorted(seeds.items()))
    width = "" if group[1] is None else f" width {group[1]}"
    sentence = (
        f"results of {group[0]}{width} with a seed that not every policy has: {alone:,} (seeds: "
        f"{counts}; shared by all: {len(shared):,})"
    )
    advice = "launch the same seeds for all of them; a paired comparison leaves the others out"
    return [Finding("warning", sentence, alone, advice)]
