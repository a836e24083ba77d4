"""Schema 6: fingerprint of the code of each launch, and the launch that registered a trial.

Both are NULL in older rows. PostgreSQL's table of the lock is created with the first lock
(:meth:`orchestrate.store.backends.postgresql.PostgreSQLBackend.exclusive`).
"""

from __future__ import annotations

import sqlalchemy
from alembic import op
from sqlalchemy.types import TypeEngine

revision = "6"
down_revision = "5"


def upgrade() -> None:
    whole: TypeEngine[int] = sqlalchemy.BigInteger().with_variant(sqlalchemy.Integer(), "sqlite")
    op.add_column("launch", sqlalchemy.Column("fingerprint", sqlalchemy.Text))
    op.add_column("trial", sqlalchemy.Column("registered_by", whole))
