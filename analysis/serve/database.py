"""Connection to the displayed database, reopened when the database file is replaced."""

from __future__ import annotations

import threading

from orchestrate.store import Reader
from orchestrate.store.database_url import parse, read_login, safe, sqlite_path

Identity = tuple[int, int] | None


class Database:
    """Access to the database at a URL, which may be missing, created later or replaced."""

    def __init__(self, url: str) -> None:
        parsed = parse(url)
        self.safe_url = safe(parsed)
        self._url = url
        self.is_file = parsed.get_backend_name() != "postgresql"
        """Whether the database is a SQLite file or a bundle, and not on a server."""
        self.user = parsed.username
        self.read_login = read_login(parsed)
        self._path = sqlite_path(parsed) if parsed.get_backend_name() == "sqlite" else None
        self._lock = threading.Lock()
        self._reader: Reader | None = None
        self._identity: Identity = None

    def reader(self) -> Reader:
        """Return a reader; raise ``StoreError`` for a missing database or another schema."""
        with self._lock:
            identity = self._file()
            if self._reader is None or identity != self._identity:
                self.close()
                self._reader = Reader.open(self._url)
                self._identity = identity
            return self._reader

    def close(self) -> None:
        """Close the connections."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _file(self) -> Identity:
        """Return device and inode of the database file; None without one or on PostgreSQL."""
        if self._path is None:
            return None
        try:
            found = self._path.stat()
        except OSError:
            self.close()
            return None
        return found.st_dev, found.st_ino
