"""Samples of the curves of trials that run, which are deleted when the trials stop running.

They are a table of their own: nothing that reads results finds them.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, delete, exists, select, text

from orchestrate.records import Sample
from orchestrate.store.records import Claim
from orchestrate.store.schema import live_step, trial
from orchestrate.store.serialization import finite

_RUNNING = exists().where(trial.c.trial_id == live_step.c.trial_id, trial.c.status == "running")
_CLEAR = delete(live_step).where(~_RUNNING)

# An attempt that a launch repeats comes to the same steps, and to the same losses.
_INSERT = text(
    "INSERT INTO live_step (trial_id, t, loss, reachable_loss) "
    "VALUES (:trial_id, :t, :loss, :reachable_loss) ON CONFLICT (trial_id, t) DO NOTHING"
)


def add(connection: Connection, samples: Sequence[tuple[Claim, Sample]]) -> None:
    """Write the samples of those trials whose claims still hold.

    Trials that another transaction has locked are left out: it may free them.
    """
    ids = {claim.trial_id for claim, _ in samples}
    holders = (
        select(trial.c.trial_id, trial.c.attempt, trial.c.owner)
        .where(trial.c.trial_id.in_(ids), trial.c.status == "running")
        .with_for_update(key_share=True, skip_locked=True)
    )
    held = {tuple(row) for row in connection.execute(holders)}
    rows = [
        {
            "trial_id": claim.trial_id,
            "t": sample.t,
            "loss": finite(sample.loss),
            "reachable_loss": finite(sample.reachable_loss),
        }
        for claim, sample in samples
        if (claim.trial_id, claim.attempt, claim.launch) in held
    ]
    if rows:
        connection.execute(_INSERT, rows)


def clear(connection: Connection) -> None:
    """Delete the samples of trials that do not run any more."""
    connection.execute(_CLEAR)
