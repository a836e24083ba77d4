"""Trials by the first digits of their keys, as git names commits."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import Any

from orchestrate.commands.filtering import chosen
from orchestrate.commands.parser import UsageError
from orchestrate.store import Reader

_SHORTEST = 4
_SHOWN = 10
_LIST = "SELECT trial_id, trial_key, config_key, env, policy, width, seed, status FROM v_trial"


def listed(reader: Reader, arguments: argparse.Namespace, **values: int | None) -> list[Any]:
    """Return the trials of the chosen configurations, in the order of their registration.

    ``values`` of columns that are not None narrow it. A row is (trial_id, trial_key, config_key,
    env, policy, width, seed, status).
    """
    cells = {cell.config_key for cell in chosen(reader, arguments)}
    given = {name: value for name, value in values.items() if value is not None}
    condition = " AND ".join(["1 = 1", *(f"{name} = :{name}" for name in given)])
    rows = reader.rows(f"{_LIST} WHERE {condition} ORDER BY trial_id", **given)
    return [row for row in rows if row.config_key in cells]


def the_one(rows: Sequence[Any], start: str | None) -> Any:
    """Return the only row, or the only one whose key starts so; else raise ``UsageError``."""
    if start is not None:
        _check(start)
        rows = [row for row in rows if row.trial_key.startswith(start.lower())]
    if len(rows) == 1:
        return rows[0]
    named = f"a key that starts with {start}" if start else "these names"
    if not rows:
        raise UsageError(
            f"There is no trial with {named}: take a key from "
            f'query "SELECT trial_key, env, policy, seed, status FROM v_trial".'
        )
    some = "; ".join(map(describe, rows[:_SHOWN]))
    rest = f" and {len(rows) - _SHOWN:,} more" if len(rows) > _SHOWN else ""
    raise UsageError(
        f"{len(rows):,} trials have {named}, one is expected: say which of {some}{rest}."
    )


def describe(row: Any) -> str:
    """Return a trial in a few words."""
    width = "" if row.width is None else f" width={row.width}"
    return f"{row.trial_key[:12]} (env={row.env} policy={row.policy}{width} seed={row.seed})"


def _check(start: str) -> None:
    if not re.fullmatch(rf"[0-9a-fA-F]{{{_SHORTEST},64}}", start):
        raise UsageError(
            f"'{start}' is no key of a trial, at least its first {_SHORTEST} hexadecimal digits "
            f"are expected: give them, or --env, --policy and --seed."
        )
