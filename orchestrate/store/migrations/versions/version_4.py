"""Schema 4: a short human label of each configuration, also as a column of the views."""

from __future__ import annotations

import json

import sqlalchemy
from alembic import op

from dopt.spec.label import config_label
from orchestrate.store.migrations.rebuilding import rebuilt

revision = "4"
down_revision = "3"


def upgrade() -> None:
    op.add_column("config", sqlalchemy.Column("label", sqlalchemy.Text))
    connection = op.get_bind()
    configs = connection.execute(sqlalchemy.text("SELECT config_id, config_json FROM config")).all()
    update = sqlalchemy.text("UPDATE config SET label = :label WHERE config_id = :config_id")
    for config_id, text in configs:
        label = config_label(json.loads(text))
        connection.execute(update, {"config_id": config_id, "label": label})
    with rebuilt("config") as batch:
        batch.alter_column("label", existing_type=sqlalchemy.Text(), nullable=False)
