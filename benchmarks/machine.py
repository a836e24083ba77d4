"""Machine and library versions of a measurement."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path

from dopt.cores import usable_cores

LIBRARIES = ("numpy", "numba", "llvmlite", "torch", "jax", "ray", "sqlalchemy", "matplotlib")


def describe() -> list[str]:
    """Return lines about the processor, its load, and the versions of the libraries."""
    cores = usable_cores()
    load = os.getloadavg()[0]
    found = [f"{name} {version}" for name in LIBRARIES if (version := _version(name))]
    return [
        f"machine: {processor()}, {cores} cores, {platform.system()} {platform.release()}, "
        f"load {load:.1f} before the start",
        f"versions: Python {platform.python_version()}, {', '.join(found)}",
    ]


def processor() -> str:
    """Return the name of the processor as the kernel knows it, with its generation."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    pairs = [line.partition(":") for line in lines]
    known = {key.strip(): value.strip() for key, _, value in reversed(pairs)}
    if "model name" not in known:
        return platform.machine()
    family, model = known.get("cpu family", "?"), known.get("model", "?")
    return f"{known['model name']} (family {family}, model {model})"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
