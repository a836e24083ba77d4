"""The laboratory of the single faults, with a grid that takes minutes."""

from __future__ import annotations

from tests.orchestrate.faults.conftest import (  # noqa: F401  pytest finds them here
    laboratory_at,
    postgresql_url,
    server,
    sqlite_url,
    undisturbed,
    url,
)
