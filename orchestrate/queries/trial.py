"""Report of one trial: configuration, launches, attempts and loss curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dopt.limits import VIOLATIONS, WORST
from dopt.spec.added_fields import completed
from orchestrate.redaction import without_password
from orchestrate.store import ExplorationRow, Reader, explorations
from orchestrate.store.serialization import stored_json

_TRIAL = "SELECT * FROM v_trial WHERE trial_id = :trial_id"
_CONFIG = "SELECT config_json FROM config WHERE config_key = :config_key"
_ATTEMPTS = """
SELECT a.attempt, a.launch_id, a.outcome, a.cause, a.node, a.pid, a.claimed, a.started, a.ended,
       a.wall_seconds, a.cpu_seconds, a.peak_memory_bytes, e.type, e.message, e.traceback
FROM attempt a
LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.trial_id = :trial_id
ORDER BY a.attempt
"""
_LOSS = "SELECT loss FROM step WHERE trial_id = :trial_id ORDER BY t"
_BEYOND = f"""
SELECT measure, value FROM assessment
WHERE trial_id = :trial_id AND measure IN ('{VIOLATIONS}', '{WORST}') ORDER BY t, measure
"""


@dataclass(frozen=True)
class TrialReport:
    """Contents of the database about one trial.

    Attributes
    ----------
    trial
        Row of ``v_trial``.
    config
        The whole configuration without the seed.
    launches
        The launches that ran it, without passwords.
    attempts
        One for each claim, with its error if there was one.
    loss
        The loss curve, with None for values that are not finite; empty if there is none.
    beyond_limits
        ``violations`` and ``worst`` of a trial with limits (:data:`dopt.assessment.MEASURES`).
    exploration
        Steps of an exploration, and whether it goes on; None for another trial.
    """

    trial: Mapping[str, Any]
    config: Mapping[str, Any]
    launches: Sequence[Mapping[str, Any]]
    attempts: Sequence[Mapping[str, Any]]
    loss: Sequence[float | None]
    beyond_limits: Mapping[str, float | None]
    exploration: ExplorationRow | None = None


def report(reader: Reader, trial_id: int) -> TrialReport:
    """Return the report of a trial; ``reader`` is a snapshot."""
    trial = reader.rows(_TRIAL, trial_id=trial_id)[0]._asdict()
    attempts = [row._asdict() for row in reader.rows(_ATTEMPTS, trial_id=trial_id)]
    tried = {attempt["launch_id"] for attempt in attempts}
    ((text,),) = reader.rows(_CONFIG, config_key=trial["config_key"])
    return TrialReport(
        trial=trial,
        config=completed(stored_json(text, dict)),
        launches=[
            {name: _public(value) for name, value in asdict(launch).items()}
            for launch in reader.launches()
            if launch.launch_id in tried
        ],
        attempts=attempts,
        loss=[row[0] for row in reader.rows(_LOSS, trial_id=trial_id)],
        beyond_limits={row[0]: row[1] for row in reader.rows(_BEYOND, trial_id=trial_id)},
        exploration=next(
            (one for one in explorations(reader) if one.trial_key == trial["trial_key"]), None
        ),
    )


def _public(value: Any) -> Any:
    return [without_password(word) for word in value] if isinstance(value, list) else value
