"""Schema 1, the first released schema: the start of the migrations, with nothing to do."""

from __future__ import annotations

revision = "1"
down_revision = None


def upgrade() -> None:
    """Do nothing: databases of schema 1 were created without Alembic.

    They keep their version in a table ``schema_version`` instead of Alembic's.
    """
