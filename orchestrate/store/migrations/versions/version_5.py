"""Schema 5: table of the samples of curves of trials that run."""

from __future__ import annotations

import sqlalchemy
from alembic import op
from sqlalchemy.types import TypeEngine

revision = "5"
down_revision = "4"


def upgrade() -> None:
    real: TypeEngine[float] = sqlalchemy.Double().with_variant(sqlalchemy.REAL(), "sqlite")
    whole: TypeEngine[int] = sqlalchemy.BigInteger().with_variant(sqlalchemy.Integer(), "sqlite")
    op.create_table(
        "live_step",
        sqlalchemy.Column("trial_id", whole, sqlalchemy.ForeignKey("trial.trial_id")),
        sqlalchemy.Column("t", sqlalchemy.Integer, autoincrement=False),
        sqlalchemy.Column("loss", real),
        sqlalchemy.Column("reachable_loss", real),
        sqlalchemy.PrimaryKeyConstraint("trial_id", "t"),
        sqlite_strict=True,
        sqlite_with_rowid=False,
    )
