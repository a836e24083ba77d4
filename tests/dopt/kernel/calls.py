"""Calls of single functions of the kernel on the system of a trial."""

from __future__ import annotations

from typing import Any

from dopt.kernel.pointers import compiled_for, kind_of, path_of
from dopt.types import CompiledFunction


def call(function: CompiledFunction, *arguments: Any) -> Any:
    """Call a compiled function with pointers to the equations of a plant, as a trial does.

    Python's own call would compile it for each system, in every process, for seconds each time.
    Behind pointers one compilation serves all systems, and the cache of the kernel keeps it.
    """
    kinds = tuple(map(kind_of, arguments))
    return compiled_for(path_of(function), function, kinds)(*arguments)
