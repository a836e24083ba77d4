"""File ``views.sql`` of a bundle: its tables and views for DuckDB."""

from __future__ import annotations

from orchestrate.store.bundle import TABLES, file_name
from orchestrate.store.views import VIEWS

VIEWS_FILE = "views.sql"

_HEAD = """\
-- Tables and views of these results for DuckDB, in the folder of the bundle:
--   duckdb -init views.sql
-- or, from anywhere, SET file_search_path = 'FOLDER' before.

-- Whole numbers are divided as in SQLite and PostgreSQL: 3 / 2 = 1.
SET integer_division = true;

"""


def views_sql() -> str:
    """Return the statements; files are named relative to the folder of the bundle."""
    tables = [
        f"CREATE OR REPLACE VIEW {name} AS SELECT * FROM read_parquet('{file_name(name)}');\n"
        for name in TABLES
    ]
    views = [f"\nCREATE OR REPLACE VIEW {name} AS{sql.rstrip()};\n" for name, sql in VIEWS.items()]
    return "".join([_HEAD, *tables, *views])
