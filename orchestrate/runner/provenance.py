"""Provenance of a launch: command, host, processor, code and libraries."""

from __future__ import annotations

import hashlib
import os
import platform
import socket
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from dopt import __version__
from orchestrate.fingerprint import fingerprint
from orchestrate.program import COMMIT_VARIABLE, commit_of, git
from orchestrate.redaction import without_password_in_word
from orchestrate.store import LaunchRecord

LIBRARIES = (
    "hydra-core",
    "llvmlite",
    "numba",
    "numpy",
    "omegaconf",
    "psycopg",
    "ray",
    "scipy",
    "sqlalchemy",
    "torch",
)

LARGEST_FILE_BYTES = 16 * 2**20
"""Largest untracked file that is hashed; of a larger one the size is taken."""

SOURCES = ("*.py", "*.yaml", "*.yml", "*.toml", ":(exclude)build", ":(exclude)dist")
"""Git path patterns of untracked files that can change a result: code and configuration."""


def launch_record(argv: Sequence[str], overrides: Sequence[str], root: Path) -> LaunchRecord:
    """Return the provenance of this process, without passwords.

    Parameters
    ----------
    argv, overrides
        The command line, and what Hydra took as overrides.
    root
        Folder of the code, whose commit is noted if it is a git repository of its own, otherwise
        the one that ``DOPT_COMMIT`` gives.
    """
    commit = commit_of(root)
    difference = _difference(root) if commit else None
    return LaunchRecord(
        argv=[without_password_in_word(word) for word in argv],
        overrides=[without_password_in_word(word) for word in overrides],
        host=socket.gethostname(),
        pid=os.getpid(),
        git_commit=commit or os.environ.get(COMMIT_VARIABLE) or None,
        git_dirty=bool(difference) if commit else None,
        git_diff_hash=hashlib.sha256(difference).hexdigest() if difference else None,
        versions={**_versions(), **_processor()},
        fingerprint=fingerprint(),
    )


def _difference(root: Path) -> bytes:
    """Return the difference of the working tree from its commit, with untracked sources.

    Untracked files of other kinds, such as exported results, change no number and do not count.
    """
    changed = git(root, "diff", "--binary", "--no-ext-diff", "--no-textconv", "HEAD") or b""
    added = git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *SOURCES) or b""
    new = [name + b"\0" + _content(root, name) for name in sorted(added.split(b"\0")) if name]
    return b"\0".join([changed, *new]) if changed or new else b""


def _content(root: Path, name: bytes) -> bytes:
    """Return the hash of a file, or its size if it is too large."""
    path = root / os.fsdecode(name)
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE_BYTES:
            return str(size).encode()
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError:
        return b"unreadable"


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version(), "dopt": __version__}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _processor() -> dict[str, str]:
    """Return the processor that the kernel is compiled for; rounding depends on it."""
    from llvmlite import binding

    features = binding.get_host_cpu_features().flatten()
    return {
        "platform": platform.platform(),
        "cpu": binding.get_host_cpu_name(),
        "cpu_model": _cpu_model(),
        "cpu_features": hashlib.sha256(features.encode()).hexdigest()[:16],
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
