"""From any released schema to the newest one, by Alembic, on a connection of the program.

A new database is made from :mod:`orchestrate.store.schema` and stamped; only an older one passes
through the scripts in ``versions/``. Each has the number of the schema that it leads to.
"""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, inspect, text

from orchestrate.store.schema import alembic_version
from orchestrate.store.views import VIEWS

LOCATION = Path(__file__).parent


def stamp(connection: Connection, version: int) -> None:
    """Note the version of a database that has none yet in Alembic's table, which is made."""
    alembic_version.create(connection, checkfirst=True)
    connection.execute(alembic_version.insert().values(version_num=str(version)))


def migrate(connection: Connection, version: int) -> None:
    """Bring a database from ``version`` to the newest one, in the transaction of the caller.

    The views stand aside meanwhile: a table below a view cannot be changed everywhere.
    """
    drop_views(connection)
    if not inspect(connection).has_table(alembic_version.name):
        stamp(connection, version)
    command.upgrade(_configuration(connection), "head")
    create_views(connection)


def create_views(connection: Connection) -> None:
    for name, query in VIEWS.items():
        connection.execute(text(f"CREATE VIEW {name} AS {query}"))


def drop_views(connection: Connection) -> None:
    """Drop the program's views; those that somebody else made stay."""
    there = set(inspect(connection).get_view_names())
    for name in reversed(VIEWS):
        if name in there:
            connection.execute(text(f"DROP VIEW {name}"))


def _configuration(connection: Connection) -> Config:
    configuration = Config()
    # The parser of the configuration would take a % in the path for a reference.
    configuration.set_main_option("script_location", str(LOCATION).replace("%", "%%"))
    configuration.attributes["connection"] = connection
    return configuration
