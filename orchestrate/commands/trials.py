"""Selection of trials by the first digits of their keys, as git selects commits."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass

from orchestrate.cli_parser import UsageError
from orchestrate.commands.filtering import chosen
from orchestrate.queries.config_columns import COLUMNS, column_text, differing
from orchestrate.store import ConfigRow, Reader

_MIN_DIGITS = 4
_MAX_LISTED = 10
_NAMES = ("env", "policy")
_TRIALS = "SELECT trial_id, trial_key, config_key, width, seed, status FROM v_trial"


@dataclass(frozen=True)
class ListedTrial:
    """One trial with its configuration."""

    trial_id: int
    trial_key: str
    seed: int
    status: str
    config: ConfigRow


def listed(
    reader: Reader, arguments: argparse.Namespace, **values: int | None
) -> list[ListedTrial]:
    """Return the trials of the chosen configurations, in the order of their registration.

    ``values`` of columns that are not None select a part of them.
    """
    configs = {config.config_key: config for config in chosen(reader, arguments)}
    given = {name: value for name, value in values.items() if value is not None}
    condition = " AND ".join(["1 = 1", *(f"{name} = :{name}" for name in given)])
    rows = reader.rows(f"{_TRIALS} WHERE {condition} ORDER BY trial_id", **given)
    return [
        ListedTrial(row.trial_id, row.trial_key, row.seed, row.status, configs[row.config_key])
        for row in rows
        if row.config_key in configs
    ]


def the_one(trials: Sequence[ListedTrial], start: str | None) -> ListedTrial:
    """Return the only trial, or the only one with a key that starts with ``start``.

    Raises ``UsageError`` if there is none, or more than one.
    """
    if start is not None:
        _check(start)
        trials = [trial for trial in trials if trial.trial_key.startswith(start.lower())]
    if len(trials) == 1:
        return trials[0]
    named = f"a key that starts with {start}" if start else "these names"
    if not trials:
        raise UsageError(
            f"There is no trial with {named}: take a key from "
            f'query "SELECT trial_key, env, policy, seed, status FROM v_trial".'
        )
    columns = differing([trial.config for trial in trials], always=(*_NAMES, "width"))
    some = "; ".join(describe(trial, columns) for trial in trials[:_MAX_LISTED])
    rest = f" and {len(trials) - _MAX_LISTED:,} more" if len(trials) > _MAX_LISTED else ""
    raise UsageError(
        f"{len(trials):,} trials have {named}, one is expected: "
        f"give the key of one of {some}{rest}."
    )


def describe(trial: ListedTrial, columns: Sequence[str] = COLUMNS) -> str:
    """Return the first digits of the key, the columns that have a value, and the seed."""
    texts = {name: column_text(trial.config, name) for name in columns}
    words = [f"{name}={text}" for name, text in texts.items() if text != "-"]
    return f"{trial.trial_key[:12]} ({' '.join(words)} seed={trial.seed})"


def _check(start: str) -> None:
    if not re.fullmatch(rf"[0-9a-fA-F]{{{_MIN_DIGITS},64}}", start):
        raise UsageError(
            f"'{start}' is no key of a trial, at least its first {_MIN_DIGITS} hexadecimal digits "
            f"are expected: give them, or --env, --policy and --seed."
        )
