"""Where a launch comes from: command, host, code and libraries."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import socket
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from orchestrate.store import LaunchRecord

LIBRARIES = (
    "dopt",
    "hydra-core",
    "numba",
    "numpy",
    "omegaconf",
    "ray",
    "scipy",
    "sqlalchemy",
    "torch",
)
_PASSWORD = re.compile(r"(://[^:/@\s]*):[^@\s]*@")


def launch_record(argv: Sequence[str], overrides: Sequence[str], root: Path) -> LaunchRecord:
    """Return the provenance of this process, without passwords.

    Parameters
    ----------
    argv, overrides
        The command line, and what Hydra took as overrides.
    root
        Folder of the code, whose commit is noted if it is a git repository.
    """
    commit = _git(root, "rev-parse", "HEAD")
    diff = _git(root, "diff", "HEAD") if commit else None
    changed = _git(root, "status", "--porcelain") if commit else None
    return LaunchRecord(
        argv=[without_password(word) for word in argv],
        overrides=[without_password(word) for word in overrides],
        host=socket.gethostname(),
        pid=os.getpid(),
        git_commit=commit.strip() if commit else None,
        git_dirty=None if changed is None else bool(changed.strip()),
        git_diff_hash=hashlib.sha256(diff.encode()).hexdigest() if diff else None,
        versions={"python": platform.python_version(), **_versions()},
    )


def without_password(text: str) -> str:
    """Return ``text`` with the password of any URL in it replaced."""
    return _PASSWORD.sub(r"\1:***@", text)


def _versions() -> dict[str, str]:
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _git(root: Path, *arguments: str) -> str | None:
    """Return what git prints, or None outside a repository and without git."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode(errors="replace")
