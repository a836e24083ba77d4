"""Labels of configurations that an upgrade left without one."""

from __future__ import annotations

import json

from sqlalchemy import Connection, bindparam, select, update

from dopt.spec.label import config_label
from orchestrate.store.schema import config


def write_missing(connection: Connection) -> None:
    """Write the label of each configuration whose label is empty."""
    columns = select(config.c.config_id, config.c.config_json).where(config.c.label == "")
    rows = [
        {"id": config_id, "text": config_label(json.loads(text))}
        for config_id, text in connection.execute(columns)
    ]
    if rows:
        statement = update(config).where(config.c.config_id == bindparam("id"))
        connection.execute(statement.values(label=bindparam("text")), rows)
