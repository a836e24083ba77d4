"""Compilation of functions of a user's own file."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numba

from dopt.kernel.compiler import compilable
from dopt.types import CompiledFunction


@functools.cache
def compiled_here(function: Callable[..., None]) -> CompiledFunction:
    """Return a function that compiles in this process alone.

    The folder of the cache is named after the sources of this package, which do not hold it.
    """
    return numba.njit(error_model="numpy", fastmath=False)(compilable(function))
