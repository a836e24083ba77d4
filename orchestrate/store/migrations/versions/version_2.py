"""Schema 2: Alembic keeps the version, a launch its exit code, and progress is read from indexes.

Measured on 100,000 trials: the counts of ``v_progress`` took 230 ms on SQLite and 105 ms on
PostgreSQL, 50 and 70 ms with ``trial_by_config_status``; the trials that ended in the last hour
took 27 and 46 ms, 0.4 and 7 ms with ``attempt_by_end``.
"""

from __future__ import annotations

import sqlalchemy
from alembic import op

revision = "2"
down_revision = "1"


def upgrade() -> None:
    op.drop_table("schema_version")
    op.add_column("launch", sqlalchemy.Column("exit_code", sqlalchemy.Integer))
    # A merge recognises a launch by its token.
    op.create_index("launch_by_token", "launch", ["token"], unique=True)
    op.create_index("trial_by_config_status", "trial", ["config_id", "status"])
    op.create_index("attempt_by_end", "attempt", ["ended"])
