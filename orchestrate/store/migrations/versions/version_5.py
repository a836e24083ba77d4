"""Schema 5, the oldest that is upgraded: the start of the migrations, with nothing to do."""

from __future__ import annotations

revision = "5"
down_revision = None


def upgrade() -> None:
    """Do nothing."""
