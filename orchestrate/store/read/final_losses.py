"""Final losses of the trials of a grid, which decide whether it needs more seeds."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select

from orchestrate.store.backends.base import Backend
from orchestrate.store.schema import trial


def final_losses(
    connection: Connection, backend: Backend, trial_keys: Sequence[str]
) -> dict[str, float]:
    """Return the final loss of those of the trials that are done and did not diverge."""
    statement = select(trial.c.trial_key, trial.c.final_loss).where(
        trial.c.trial_key.in_(backend.members(trial_keys)),
        trial.c.status == "done",
        trial.c.final_loss.is_not(None),
    )
    return {key: float(loss) for key, loss in connection.execute(statement)}
