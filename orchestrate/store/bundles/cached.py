"""SQLite copies of bundles, which readers query; one for each content of a bundle.

They are in the folder ``dopt/bundles`` of the user's cache, and can be deleted at any time.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from dopt.given_path import given_path
from orchestrate.store.backends.file_locks import file_lock
from orchestrate.store.bundles import checksums
from orchestrate.store.bundles.filling import fill
from orchestrate.store.bundles.tables import KIND, PROVENANCE, TABLES, file_name
from orchestrate.store.errors import NoDatabaseError, SchemaVersionError, StoreUnavailableError
from orchestrate.store.schema import SCHEMA_VERSION

CACHE_VARIABLE = "DOPT_CACHE"
"""Environment variable with another cache, which compiled code uses too."""

PATIENCE_SECONDS = 600.0
"""Longest wait for another process that copies a bundle."""

DAYS_KEPT = 30
"""A copy that was not opened for so many days is deleted when another one is made."""


def database_of(folder: Path, safe_url: str) -> Path:
    """Return the SQLite copy of a bundle, and make it if there is none.

    Every file is checked against its SHA-256 first. Raises ``NoDatabaseError`` if there is no
    folder, ``StoreError`` for a folder that is no bundle, ``SchemaVersionError`` for a bundle of
    another schema, and ``StoreUnavailableError`` for a damaged file, which the message names.
    """
    if not folder.is_dir():
        raise NoDatabaseError(
            f"There is no folder {folder} of the bundle {safe_url}: give a folder that "
            "'python -m orchestrate export bundle' has written."
        )
    expected = checksums.read(folder, safe_url)
    needed = dict.fromkeys([PROVENANCE, *map(file_name, TABLES)], "")
    checksums.verify(folder, {**needed, **expected})
    _check_version(folder, safe_url)
    copies = copies_folder()
    copy = copies / f"{_identity(expected)}.db"
    with file_lock(copies / "lock", PATIENCE_SECONDS):
        if copy.is_file():
            copy.touch()
        else:
            _remove_unused(copies)
            _make(copy, folder)
    return copy


def _check_version(folder: Path, safe_url: str) -> None:
    facts = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    if not isinstance(facts, dict) or facts.get("kind") != KIND:
        raise StoreUnavailableError(
            f"{safe_url} is no bundle of results, its {PROVENANCE} describes something else: give "
            "a folder that 'python -m orchestrate export bundle' has written."
        )
    version = str(facts.get("schema_version"))
    if version != str(SCHEMA_VERSION):
        raise SchemaVersionError(
            f"The bundle {safe_url} has schema {version}, this program reads schema "
            f"{SCHEMA_VERSION}: read it with {facts.get('program')}, which has written it, or "
            "export its database again."
        )


def _identity(expected: Mapping[str, str]) -> str:
    text = json.dumps([SCHEMA_VERSION, sorted(expected.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def _make(copy: Path, folder: Path) -> None:
    partial = copy.with_suffix(".partial")
    partial.unlink(missing_ok=True)
    try:
        fill(partial, folder)
        partial.replace(copy)
    finally:
        partial.unlink(missing_ok=True)


def _remove_unused(copies: Path) -> None:
    oldest = time.time() - DAYS_KEPT * 86_400
    for path in copies.glob("*.db"):
        if path.stat().st_mtime < oldest:
            path.unlink()


def copies_folder() -> Path:
    """Return a writable folder for the copies: a temporary one where the cache is read-only."""
    base = os.environ.get(CACHE_VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    root = given_path(base, CACHE_VARIABLE) if base else Path.home() / ".cache"
    folder = root / "dopt" / "bundles"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return _temporary()


@cache
def _temporary() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="dopt-bundles-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
