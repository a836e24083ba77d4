"""Fingerprint of code, libraries and settings, compared on each worker of a cluster first.

Ray finds a function on a worker by its name, in the code installed there. The functions of this
module are pickled by value instead: they run before any module of this project is imported on the
worker. Sending all of the code was measured to be no slower (2 s to the first result either way),
but compiled code is cached by the path of its sources, and Ray unpacks code into a new folder for
each session, which would compile for a minute.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

Fingerprint = Mapping[str, str]
"""Values that must be equal on all nodes, by name."""

_SOURCES = {"dopt": (".",), "orchestrate": ("executors", "records.py")}
_LIBRARIES = ("llvmlite", "numba", "numpy", "scipy", "torch")
_SETTING = "RAY_"

_verified: list[bool] = []  # not empty once this process has compared its fingerprint


def fingerprint(settings: Sequence[str]) -> dict[str, str]:
    """Return the versions that numbers depend on, and the ``settings`` of the environment."""
    found = {"Python": platform.python_version()}
    found |= {f"code of {package}": _digest(package, parts) for package, parts in _SOURCES.items()}
    found |= {f"version of {library}": _version(library) for library in _LIBRARIES}
    return found | {name: os.environ.get(name, "unset") for name in settings}


def run_where_alike(
    expected: Fingerprint, payload: bytes, channel: tuple[float, Any] | None = None
) -> Iterator[Any]:
    """Run a chunk, or yield one clause that names the difference.

    ``payload`` holds the pickled arguments of
    :func:`orchestrate.executors.ray.chunk.run_chunk`, whose outcomes are yielded, but for the
    channel, which holds an actor.
    """
    if not _verified:
        found = fingerprint([name for name in expected if name.startswith(_SETTING)])
        for name, value in expected.items():
            if found[name] != value:
                yield f"on node {platform.node()} the {name} is {found[name]}, here it is {value}"
                return
        _verified.append(True)
    from ray import cloudpickle

    chunk = importlib.import_module("orchestrate.executors.ray.chunk")
    yield from chunk.run_chunk(*cloudpickle.loads(payload), channel)


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
