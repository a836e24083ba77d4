"""A database of every schema that was ever released, of each kind, written by its program.

Each holds trials of every fate: done, diverged, failed, and two that a killed launch left running.
``vN.db`` is the SQLite file, ``vN.sql`` what ``pg_dump --inserts -n released`` made of the same.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from sqlalchemy import create_engine
from sqlalchemy.engine import make_url

FOLDER = Path(__file__).parent
VERSIONS = sorted(int(path.stem[1:]) for path in FOLDER.glob("v*.db"))


def restore(version: int, url: str) -> None:
    """Make the released database at the URL, where there is nothing or an empty schema."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite":
        path = Path(str(parsed.database))
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(FOLDER / f"v{version}.db", path)
        return
    schema = str(parsed.query["options"]).rpartition("=")[2]
    dump = (FOLDER / f"v{version}.sql").read_text().replace('"released"', f'"{schema}"')
    dump = dump.replace("released.", f"{schema}.")
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.exec_driver_sql(f'DROP SCHEMA "{schema}"')
        connection.exec_driver_sql(dump, execution_options={"no_parameters": True})
    engine.dispose()
