"""Check of packed curves: no array is damaged."""

from __future__ import annotations

from orchestrate.store import packed_curves
from orchestrate.store.doctor.findings import Finding, found
from orchestrate.store.read.reader import Reader
from orchestrate.store.schema import STEP_VALUES

_ROWS = f"SELECT trial_id, {', '.join(STEP_VALUES)} FROM curve ORDER BY trial_id"
_ADVICE = "delete all rows of the table curve and run 'python -m orchestrate upgrade'"
_BATCH = 1_000


def damaged_curves(moment: Reader) -> list[Finding]:
    """Return a finding of the trials with a damaged array; none where nothing is packed."""
    if not moment.has_packed_curves():
        return []
    damaged = [
        trial_id
        for rows in moment.batches(_BATCH, _ROWS)
        for trial_id, *arrays in rows
        if any(not len(packed_curves.unpacked(one)) for one in arrays)
    ]
    if not damaged:
        return []
    what = "trials with a packed curve that is damaged"
    return [found("error", what, len(damaged), f"trial_id {damaged[0]}", _ADVICE)]
