"""A PostgreSQL server of our own, to be restarted, stopped and cut off as a test likes."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import uuid
from pathlib import Path
from typing import Any

import psycopg

from tests.waiting import PATIENCE_SECONDS

ACCOUNT = "postgres"
"""User of the system that the server runs as where we are root, which it refuses to be."""

_OTHERS = "FROM pg_stat_activity WHERE backend_type = 'client backend' AND pid <> pg_backend_pid()"


class Server:
    """A cluster in a folder of its own, on a free port of the loopback address."""

    def __init__(self) -> None:
        self._bin = binaries()
        # Beside pytest's folder, which only we may enter: in memory, where each table is made in a
        # quarter of the time.
        place = os.environ.get("PYTEST_DEBUG_TEMPROOT")
        self.folder = Path(tempfile.mkdtemp(prefix="dopt-postgresql-", dir=place))
        self.port = _free_port()
        if os.geteuid() == 0:
            shutil.chown(self.folder, ACCOUNT)
        self._run("initdb", "--auth=trust", f"--username={ACCOUNT}", "--no-sync", "-D", self._data)
        self.start()

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://{ACCOUNT}@127.0.0.1:{self.port}/postgres"

    @property
    def _data(self) -> str:
        return str(self.folder / "data")

    def start(self) -> None:
        self._control("start", "-l", str(self.folder / "log"), "-o", self._options())

    def restart(self, mode: str) -> None:
        """Restart "fast", which rolls back and says goodbye, or "immediate", which does not."""
        log = str(self.folder / "log")
        self._control("restart", "-m", mode, "-l", log, "-o", self._options())

    def stop(self, mode: str = "fast") -> None:
        self._control("stop", "-m", mode)

    def remove(self) -> None:
        """Stop the server if it runs, and delete all that it has."""
        if (self.folder / "data" / "postmaster.pid").exists():
            self.stop("immediate")
        shutil.rmtree(self.folder)

    def terminate_backends(self) -> int:
        """End every connection but our own; return how many there were."""
        rows = self.query(f"SELECT pg_terminate_backend(pid) {_OTHERS}")
        return len(rows)

    def new_url(self) -> str:
        """Return the URL of a new, empty schema."""
        schema = f"lab_{uuid.uuid4().hex[:8]}"
        self.query(f"CREATE SCHEMA {schema}")
        return f"{self.url}?options=-csearch_path%3D{schema}"

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        address = f"host=127.0.0.1 port={self.port} user={ACCOUNT} dbname=postgres"
        with psycopg.connect(address, autocommit=True, connect_timeout=60) as connection:
            cursor = connection.execute(sql)  # type: ignore[arg-type]
            return cursor.fetchall() if cursor.description else []

    def _options(self) -> str:
        # Without fsync a power failure would cost data, the death of the server does not.
        settings = {"listen_addresses": "127.0.0.1", "fsync": "off", "max_connections": "60"}
        words = [f"-c {key}={value}" for key, value in settings.items()]
        return " ".join([f"-p {self.port}", f"-k {self.folder}", *words])

    def _control(self, *arguments: str) -> None:
        self._run("pg_ctl", "-w", "-t", f"{PATIENCE_SECONDS:.0f}", "-D", self._data, *arguments)

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._bin / program), *arguments]
        if os.geteuid() == 0:
            command = ["runuser", "-u", ACCOUNT, "--", *command]
        # Into a file: the server inherits it, and a pipe would not end before the server does.
        with (self.folder / f"{program}.txt").open("w+") as output:
            done = subprocess.run(command, cwd=self.folder, stdout=output, stderr=output)
            output.seek(0)
            assert done.returncode == 0, output.read()


def binaries() -> Path:
    """Return the folder of the newest server's programs.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    if not found and not on_path:
        raise FileNotFoundError("there is no initdb: install PostgreSQL's server")
    return found[-1].parent if found else Path(str(on_path)).resolve().parent


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])
