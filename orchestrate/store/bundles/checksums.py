"""SHA-256 of the files of a bundle, in the form that ``sha256sum --check`` reads."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

from orchestrate.store.errors import StoreError, StoreUnavailableError

CHECKSUMS = "SHA256SUMS"

_LINE = re.compile(r"([0-9a-f]{64}) [ *]([\w.-]+)")
_RESTORE = "copy or download the bundle again"


def write(folder: Path) -> None:
    """Write the checksums of all files of the folder."""
    files = sorted(path for path in folder.iterdir() if path.name != CHECKSUMS)
    lines = [f"{_digest(path)}  {path.name}\n" for path in files]
    (folder / CHECKSUMS).write_text("".join(lines))


def read(folder: Path, safe_url: str) -> dict[str, str]:
    """Return the checksum of each file that the bundle lists; raise ``StoreError`` for others."""
    listed = folder / CHECKSUMS
    if not listed.is_file():
        raise StoreError(
            f"{safe_url} is no bundle, because it has no file {CHECKSUMS}: give a folder that "
            "'python -m orchestrate export bundle' has written, or the URL of a database."
        )
    lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
    found = [_LINE.fullmatch(line) for line in lines]
    if not all(found):
        raise StoreUnavailableError(
            f"The file {listed} is damaged, lines with a SHA-256 and a name are expected: "
            f"{_RESTORE}."
        )
    return {match[2]: match[1] for match in found if match}


def verify(folder: Path, expected: Mapping[str, str]) -> None:
    """Raise ``StoreUnavailableError``, with the name of the file, if one differs or is missing."""
    for name, digest in expected.items():
        path = folder / name
        if not path.is_file():
            raise StoreUnavailableError(
                f"The file {path} of the bundle, listed in {CHECKSUMS}, is missing: {_RESTORE}."
            )
        if _digest(path) != digest:
            raise StoreUnavailableError(
                f"The file {path} of the bundle is damaged, its SHA-256 is not the one in "
                f"{CHECKSUMS}: {_RESTORE}."
            )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
