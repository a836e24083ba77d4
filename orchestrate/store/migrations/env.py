"""Alembic environment: runs the scripts on the given connection, in its transaction."""

from __future__ import annotations

from alembic import context

from orchestrate.store.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
context.run_migrations()
