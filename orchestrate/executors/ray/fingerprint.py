"""What a worker of a cluster does first: see that its code is that of the launch.

Ray finds a function on a worker by its name, in whatever code that machine has. The functions of
this module are sent as they are instead: they need nothing of ours on the other side, and look
before anything of ours is imported there. To send all of the code was measured to be no slower
(2 s to the first result either way), but compiled code is kept by the path of its sources, and Ray
unpacks what it is sent into a new folder for each session, which would compile for a minute.
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
"""What must be the same on all nodes, by name."""

_SOURCES = {"dopt": ".", "orchestrate": "executors"}
_LIBRARIES = ("llvmlite", "numba", "numpy", "scipy", "torch")
_SETTING = "RAY_"

_alike: list[bool] = []  # not empty once this process has looked


def fingerprint(settings: Sequence[str]) -> dict[str, str]:
    """Return what decides about numbers, and the ``settings`` of the environment."""
    found = {"Python": platform.python_version()}
    found |= {f"code of {package}": _digest(package, part) for package, part in _SOURCES.items()}
    found |= {f"version of {library}": _version(library) for library in _LIBRARIES}
    return found | {name: os.environ.get(name, "unset") for name in settings}


def run_where_alike(expected: Fingerprint, payload: bytes) -> Iterator[Any]:
    """Run a chunk, or yield one clause that says what differs here.

    ``payload`` is what the launch has pickled: the arguments of
    :func:`orchestrate.executors.ray_chunk.run_chunk`, whose outcomes are yielded.
    """
    if not _alike:
        found = fingerprint([name for name in expected if name.startswith(_SETTING)])
        for name, value in expected.items():
            if found[name] != value:
                yield f"on node {platform.node()} the {name} is {found[name]}, here it is {value}"
                return
        _alike.append(True)
    from ray import cloudpickle

    chunk = importlib.import_module("orchestrate.executors.ray_chunk")
    yield from chunk.run_chunk(*cloudpickle.loads(payload))


def _digest(package: str, part: str) -> str:
    """Return a digest of the sources that ``import`` would find, without importing them."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return "not installed"
    folder = Path(next(iter(spec.submodule_search_locations))) / part
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(f"{path.relative_to(folder)}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _version(library: str) -> str:
    try:
        return metadata.version(library).partition("+")[0]  # 2.13.0+cpu computes what 2.13.0 does
    except metadata.PackageNotFoundError:
        return "not installed"
