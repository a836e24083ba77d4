"""Schema 3: table of assessments, one row for each trial, step and measure."""

from __future__ import annotations

import sqlalchemy
from alembic import op
from sqlalchemy.types import TypeEngine

revision = "3"
down_revision = "2"


def upgrade() -> None:
    real: TypeEngine[float] = sqlalchemy.Double().with_variant(sqlalchemy.REAL(), "sqlite")
    whole: TypeEngine[int] = sqlalchemy.BigInteger().with_variant(sqlalchemy.Integer(), "sqlite")
    op.create_table(
        "assessment",
        sqlalchemy.Column("trial_id", whole, sqlalchemy.ForeignKey("trial.trial_id")),
        sqlalchemy.Column("t", sqlalchemy.Integer, autoincrement=False),
        sqlalchemy.Column("measure", sqlalchemy.Text),
        sqlalchemy.Column("value", real),
        sqlalchemy.PrimaryKeyConstraint("trial_id", "t", "measure"),
        sqlite_strict=True,
        sqlite_with_rowid=False,
    )
