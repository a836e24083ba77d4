"""Schema 7: no table of the samples of running trials any more."""

from __future__ import annotations

from alembic import op

revision = "7"
down_revision = "6"


def upgrade() -> None:
    op.drop_table("live_step")
