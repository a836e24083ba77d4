"""Fingerprint of the code, libraries and settings that numbers depend on.

Each launch stores its own, and each worker of a Ray cluster is compared first. The module imports
the standard library only: Ray carries its functions to a worker by value.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

Fingerprint = Mapping[str, str]
"""Values that must be equal on all nodes, by name."""

_SOURCES = {"dopt": (".",), "orchestrate": ("executors", "records.py")}
_LIBRARIES = ("llvmlite", "numba", "numpy", "scipy", "torch")


def fingerprint(settings: Sequence[str] = ()) -> dict[str, str]:
    """Return the versions that numbers depend on, and the ``settings`` of the environment."""
    found = {"Python": platform.python_version()}
    found |= {f"code of {package}": _digest(package, parts) for package, parts in _SOURCES.items()}
    found |= {f"version of {library}": _version(library) for library in _LIBRARIES}
    return found | {name: os.environ.get(name, "unset") for name in settings}


def differences(one: Fingerprint, other: Fingerprint) -> str:
    """Return a clause that names the values that differ, here (``other``) after there."""
    return ", ".join(
        f"the {name} is {one.get(name, 'unknown')} there and {value} here"
        for name, value in other.items()
        if one.get(name) != value
    )


def _digest(package: str, parts: Sequence[str]) -> str:
    """Return a digest of the installed sources without importing them."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return "not installed"
    folder = Path(next(iter(spec.submodule_search_locations)))
    digest = hashlib.sha256()
    for path in sorted(path for part in parts for path in _files(folder / part)):
        digest.update(f"{path.relative_to(folder)}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _files(path: Path) -> Iterator[Path]:
    """Yield a file, or the sources below a folder."""
    yield from path.rglob("*.py") if path.is_dir() else [path]


def _version(library: str) -> str:
    try:
        return metadata.version(library).partition("+")[0]  # 2.13.0+cpu gives the numbers of 2.13.0
    except metadata.PackageNotFoundError:
        return "not installed"
