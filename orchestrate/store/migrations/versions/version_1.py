"""Schema 1, the first one released; it was made without Alembic, so nothing leads to it."""

from __future__ import annotations

revision = "1"
down_revision = None


def upgrade() -> None:
    """Do nothing: such a database exists already, with its version in a table of our own."""
