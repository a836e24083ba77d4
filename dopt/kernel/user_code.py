"""Compilation of functions of a user's own file, and the cache of their machine code."""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

from dopt.kernel.cache import COMPILED_SOURCES, errors_of_the_system, one_compiler_at_a_time
from dopt.kernel.compiler import compilable
from dopt.kernel.stored_code import StoredCode
from dopt.types import CompiledFunction, NumbaType

LIBRARIES = ("numpy", "math", "cmath", "builtins")
"""Modules whose functions change only with an installation."""

_SOURCES = tuple(f"dopt.{source.removesuffix('.py')}" for source in COMPILED_SOURCES)


def compiled_own(function: Callable[..., None], signature: NumbaType) -> CompiledFunction:
    """Return a function of a user's own, compiled for a signature or found in the cache."""
    compiled = _dispatcher(function)
    digest = content_digest(function)
    if digest is None:
        with errors_of_the_system():
            compiled.compile(signature)
        return compiled
    kind = hashlib.sha256(f"{digest}{signature}".encode()).hexdigest()[:16]
    with one_compiler_at_a_time(f"{function.__module__}.{function.__qualname__}-{kind}"):
        compiled.compile(signature)
    return compiled


@functools.cache
def _dispatcher(function: Callable[..., None]) -> CompiledFunction:
    compiled = numba.njit(error_model="numpy", fastmath=False)(compilable(function))
    digest = content_digest(function)
    if digest is not None:
        compiled._cache = StoredCode(function, f"own/{digest}")
    return compiled


@functools.cache
def content_digest(function: Callable[..., None]) -> str | None:
    """Return a digest of all that the machine code of a function depends on.

    That is its file, the constants that it and its helpers read, and this package. It is None, and
    the function compiles in every process, where it has no file or uses anything else.
    """
    try:
        digest = hashlib.sha256(Path(inspect.getfile(function)).read_bytes())
    except (OSError, TypeError):  # typed into an interpreter or a notebook
        return None
    for name, value in sorted(_globals_of(function, set())):
        content = _content(value, function.__module__)
        if content is None:
            return None
        digest.update(f"{name} {content}".encode())
    return digest.hexdigest()[:16]


def _globals_of(function: Callable[..., Any], seen: set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the names and values that a function and its helpers in the same file read."""
    for name in _names(function.__code__):
        if name in function.__globals__ and name not in seen:
            seen.add(name)
            value = function.__globals__[name]
            yield name, value
            helper = getattr(value, "py_func", value)  # also one that the user has compiled
            if isinstance(helper, FunctionType) and helper.__module__ == function.__module__:
                yield from _globals_of(helper, seen)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _content(value: Any, own: str) -> str | None:
    """Return text that changes with a value in compiled code, None where it cannot be told."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, (bool, int, float, complex, str, Enum)):
        return repr(value)
    if isinstance(value, tuple):
        parts = [_content(part, own) for part in value]
        return None if None in parts else f"{parts}"
    if not (isinstance(value, ModuleType) or callable(value)):
        return None
    module = str(getattr(value, "__name__" if isinstance(value, ModuleType) else "__module__", ""))
    if module == own or module.startswith(_SOURCES) or module.partition(".")[0] in LIBRARIES:
        return module
    return None
