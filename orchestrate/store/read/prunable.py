"""Trials that a retention rule selects, with the steps that their deletion frees."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from orchestrate.store.read.reader import Reader
from orchestrate.store.schema import ENDED, N_ROWS

_TRIALS = f"""
SELECT r.trial_key, r.status, c.config_key, r.launch_id,
       CASE WHEN r.status IN ('done', 'diverged') THEN {N_ROWS} ELSE 0 END AS steps,
       (SELECT max(a.ended) FROM attempt a WHERE a.trial_id = r.trial_id) AS ended
FROM trial r JOIN config c ON c.config_id = r.config_id ORDER BY r.trial_id
"""


@dataclass(frozen=True)
class Prunable:
    """Trials that would be deleted.

    Attributes
    ----------
    keys
        Of the trials.
    statuses
        Number of them by status.
    steps
        Their rows of the table ``step``.
    size
        Bytes of the database that they take: its size by their share of all steps.
    left
        Selected trials that stay, as they have no outcome or belong to a running launch.
    """

    keys: list[str]
    statuses: dict[str, int]
    steps: int
    size: int
    left: int


def prunable(
    reader: Reader,
    configs: Collection[str],
    keys: Collection[str] | None = None,
    before: str | None = None,
) -> Prunable:
    """Return the trials of some configurations, by key, that a rule selects.

    ``keys`` restricts them to these trials, and ``before``, a time as text, to those whose last
    attempt ended before it.
    """
    alive = {one.launch_id for one in reader.launches() if one.alive}
    found, statuses = list[str](), dict[str, int]()
    steps = left = total = 0
    for row in reader.rows(_TRIALS):
        total += row.steps
        wanted = row.config_key in configs and (keys is None or row.trial_key in keys)
        if not wanted or (before is not None and not (row.ended and row.ended < before)):
            continue
        if row.status not in ENDED or row.launch_id in alive:
            left += 1
            continue
        found.append(row.trial_key)
        statuses[row.status] = statuses.get(row.status, 0) + 1
        steps += row.steps
    return Prunable(found, statuses, steps, round(reader.size() * steps / max(total, 1)), left)
