"""Schema 4: a short human label of each configuration, also as a column of the views.

Labels are left empty here: the upgrade writes them after the migrations, by the code of the
program that upgrades (:mod:`orchestrate.store.migrations.upgrade`).
"""

from __future__ import annotations

import sqlalchemy
from alembic import op

from orchestrate.store.migrations.rebuilding import rebuilt

revision = "4"
down_revision = "3"


def upgrade() -> None:
    op.add_column("config", sqlalchemy.Column("label", sqlalchemy.Text))
    op.execute("UPDATE config SET label = ''")
    with rebuilt("config") as batch:
        batch.alter_column("label", existing_type=sqlalchemy.Text(), nullable=False)
