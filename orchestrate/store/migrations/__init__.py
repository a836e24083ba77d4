"""Alembic migrations from schemas 5 and 6 to the newest one.

A new database is created from :mod:`orchestrate.store.schema` and stamped; only an older one runs
the scripts in ``versions/``. Each script has the number of the schema that it creates.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, inspect, text

from orchestrate.store.schema import alembic_version
from orchestrate.store.views import VIEWS

if TYPE_CHECKING:
    from alembic.config import Config

LOCATION = Path(__file__).parent


def stamp(connection: Connection, version: int) -> None:
    """Create Alembic's table with the version of the database."""
    alembic_version.create(connection, checkfirst=True)
    connection.execute(alembic_version.insert().values(version_num=str(version)))


def migrate(connection: Connection) -> None:
    """Migrate a database to the newest schema, in the transaction of the caller.

    The views are dropped and created again: not every database can change a table below a view.
    """
    from alembic import command  # a sixth of the start of every program, and used by none but this

    drop_views(connection)
    command.upgrade(_configuration(connection), "head")
    create_views(connection)


def create_views(connection: Connection) -> None:
    """Create the views, in place of those that an older program of this version has created."""
    if connection.dialect.name == "sqlite":
        drop_views(connection)
        create = "CREATE VIEW"
    else:
        create = "CREATE OR REPLACE VIEW"  # those of others may depend on them
    for name, query in VIEWS.items():
        connection.execute(text(f"{create} {name} AS {query}"))


def drop_views(connection: Connection) -> None:
    """Drop the views of this program, and no others."""
    existing = set(inspect(connection).get_view_names())
    for name in reversed(VIEWS):
        if name in existing:
            connection.execute(text(f"DROP VIEW {name}"))


def _configuration(connection: Connection) -> Config:
    from alembic.config import Config

    configuration = Config()
    # The configuration parser interpolates %.
    configuration.set_main_option("script_location", str(LOCATION).replace("%", "%%"))
    configuration.attributes["connection"] = connection
    return configuration
