"""Folder of compiled code for each state of the sources, and messages while it is filled.

All checkouts with the same sources share it. This module does not import Numba, which takes a
second: a launch that only wants to know whether there is anything to compile does not pay for it.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding

from dopt.given_path import given_path

CACHE_VARIABLE = "DOPT_CACHE"
_PACKAGE = Path(__file__).resolve().parent.parent
COMPILED_SOURCES = ("algorithm.py", "kernel", "systems", "math")


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
    for source in COMPILED_SOURCES:
        top = _PACKAGE / source
        for path in [top] if top.is_file() else sorted(top.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a writable folder for compiled code.

    Where the cache cannot be written it is a temporary one, for this process and those it starts.
    """
    base = os.environ.get(CACHE_VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    root = given_path(base, CACHE_VARIABLE) if base else Path.home() / ".cache"
    folder = root / "dopt" / f"kernel-{_source_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    temporary = Path(tempfile.mkdtemp(prefix="dopt-"))
    os.environ[CACHE_VARIABLE] = str(temporary)
    atexit.register(_remove, temporary, os.getpid())
    folder = temporary / folder.relative_to(root)
    folder.mkdir(parents=True)
    return folder


def _remove(folder: Path, maker: int) -> None:
    """Remove a temporary folder at the end of the process that made it, not of its forks."""
    if os.getpid() == maker:
        shutil.rmtree(folder, ignore_errors=True)


CACHE_FOLDER = _cache_folder()


@contextlib.contextmanager
def one_compiler_at_a_time(what: str) -> Iterator[None]:
    """Let one process at a time put ``what`` into the cache; once it is there, all read freely.

    ``what`` is the name of a function, and what tells its signature from its others after a hyphen.
    Numba numbers the files of a function without a lock: of two processes that compile it at once,
    one can overwrite the other's signature, and later processes then run the wrong one.
    """
    if is_complete(what):
        yield
        return
    with (CACHE_FOLDER / f"{what.partition('-')[0]}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with said(what) if not is_complete(what) else contextlib.nullcontext():
            yield
        mark_complete(what)


@contextlib.contextmanager
def said(what: str) -> Iterator[None]:
    """Say at once that a part of the kernel is compiled, and how long all parts have taken.

    The logger is ``dopt.kernel``. Its level is that of a warning, which Python shows on standard
    error where a program has set up no logging: somebody waits for it.
    """
    start = time.perf_counter()
    _said["parts"] += 1
    _log.warning(
        "compiling the kernel, once per machine: part %d, %s, %.0f s so far",
        _said["parts"],
        what.partition("-")[0],
        _said["seconds"],
    )
    yield
    _said["seconds"] += time.perf_counter() - start


_log = logging.getLogger("dopt.kernel")
_said = {"parts": 0, "seconds": 0.0}


def is_complete(what: str) -> bool:
    """Tell whether ``what`` is in the cache."""
    return (CACHE_FOLDER / f"{what}.complete").exists()


def mark_complete(what: str) -> None:
    """Remember that ``what`` is in the cache."""
    (CACHE_FOLDER / f"{what}.complete").touch()


def complete_names() -> set[str]:
    """Return the names of the functions that are in the cache, for some signature."""
    there = {path.stem for path in CACHE_FOLDER.glob("*.complete")}
    return there | {stem.rpartition("-")[0] for stem in there}
