"""``python -m tests.orchestrate.store.released [URL of PostgreSQL]``: the database of this schema.

It is the newest released one, upgraded. Run it before a change of the schema, and add its files.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from sqlalchemy import create_engine

from orchestrate.store.maintenance import upgrade
from orchestrate.store.schema import SCHEMA_VERSION
from tests.orchestrate.store.released import FOLDER, VERSIONS, restore

DUMP = ("--inserts", "--no-owner", "--quote-all-identifiers", "-n", "released")
SERVER = "postgresql+psycopg://postgres@127.0.0.1:5432/postgres"


def main(server: str = SERVER) -> None:
    last, name = max(v for v in VERSIONS if v < SCHEMA_VERSION), f"v{SCHEMA_VERSION}"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "released.db"
        restore(last, f"sqlite:///{file}")
        upgrade(f"sqlite:///{file}", backup=False)
        shutil.copy(file, FOLDER / f"{name}.db")
    engine = create_engine(server, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.exec_driver_sql("CREATE SCHEMA released")
        try:
            url = f"{server}?options=-csearch_path%3Dreleased"
            restore(last, url)
            upgrade(url, backup=False)
            plain = re.sub(r"\+\w+", "", server, count=1)
            dump = ["pg_dump", *DUMP, plain]
            text = subprocess.run(dump, check=True, capture_output=True, text=True).stdout
        finally:
            connection.exec_driver_sql("DROP SCHEMA released CASCADE")
    kept = [line for line in text.splitlines() if line and not line.startswith(("--", "\\"))]
    (FOLDER / f"{name}.sql").write_text("\n".join(kept) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
