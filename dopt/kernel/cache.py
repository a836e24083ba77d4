"""Where compiled code is kept: a folder for each state of the sources, shared by processes.

This module does not import Numba, which takes a second: a launch that only wants to know whether
there is anything to compile does not pay for it.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding

CACHE_VARIABLE = "DOPT_CACHE"
_PACKAGE = Path(__file__).resolve().parent.parent
COMPILED_SOURCES = ("kernel", "systems", "planning")


def _source_digest() -> str:
    """Return a digest of every source that ends up in compiled code.

    Numba checks only the file of the outermost function of what it finds in its cache, so a change
    in a file further in would go unnoticed: each state of the sources, and each kind of processor,
    gets a folder of its own.
    """
    digest = hashlib.sha256(version("numba").encode())
    digest.update(llvmlite.binding.get_host_cpu_name().encode())
    # Two virtual machines may name one processor and offer different parts of it.
    digest.update(llvmlite.binding.get_host_cpu_features().flatten().encode())
    # Numba files what it keeps under the path of its source: another checkout would not find it.
    digest.update(str(_PACKAGE).encode())
    for folder in COMPILED_SOURCES:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a writable folder for compiled code."""
    base = os.environ.get(CACHE_VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    root = Path(base) if base else Path.home() / ".cache"
    folder = root / "dopt" / f"kernel-{_source_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="dopt-kernel-"))


CACHE_FOLDER = _cache_folder()


@contextlib.contextmanager
def one_compiler_at_a_time(what: str) -> Iterator[None]:
    """Let one process at a time put ``what`` into the cache; once it is there, all read freely.

    Numba numbers the files of its cache without a lock: of two processes that compile at once, one
    can overwrite the other's function, and later processes then run the wrong one.
    """
    if is_complete(what):
        yield
        return
    with (CACHE_FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
        mark_complete(what)


def is_complete(what: str) -> bool:
    """Tell whether ``what`` is in the cache."""
    return (CACHE_FOLDER / f"{what}.complete").exists()


def mark_complete(what: str) -> None:
    """Remember that ``what`` is in the cache."""
    (CACHE_FOLDER / f"{what}.complete").touch()
