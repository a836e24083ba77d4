"""Decorators that compile functions of the kernel, and the files that keep their machine code.

Numba looks for machine code under the path of its source, and stores a function each time that it
compiles one, also one that only another function calls, whose code holds it already. Here the
folder belongs to a state of the sources (:mod:`dopt.kernel.cache`), the same for every checkout on
a machine, and what another function's compilation needed is not stored once more.

Code for arguments that are compiled functions themselves, as in a test that hands a plant to a
function of the kernel, is not stored: the entry would hold the argument, and whoever opens the file
would compile it. A trial hands over pointers.

Functions in a user's file are kept by the content of that file.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
import pickle
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.targetconfig import ConfigStack
from numba.extending import intrinsic, register_jitable

from dopt.kernel import cache, plain
from dopt.kernel.cache import (
    COMPILED_SOURCES,
    check_environment,
    errors_of_the_system,
    one_compiler_at_a_time,
)
from dopt.types import CompiledFunction, NumbaType, Vector

_PACKAGE = Path(__file__).resolve().parents[1]


class StoredCode(FunctionCache):  # type: ignore[misc]  # numba has no types
    """Machine code of a function, in one file of a folder of the cache for each signature."""

    def __init__(self, function: Callable[..., Any], folder: str) -> None:
        self._name, self._py_func, self._folder = repr(function), function, folder
        self.enable()

    @property
    def cache_path(self) -> str:
        return str(cache.CACHE_FOLDER / self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is stored without first loading all that Numba can compile.

        Numba's own method does that, for 0.15 s in each process; its compiler does so too, where
        there is something to compile. Machine code needs the runtime library alone.
        """
        rtsys.initialize(target_context)
        name = self._file(sig, target_context.codegen())
        code = cache.read(name)
        try:
            return code and CompileResult._rebuild(target_context, *pickle.loads(code))
        except MemoryError:
            raise
        except Exception:  # written whole, by a program that had other classes
            return cache.drop(name)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a function that Python calls; one compiled on the way is part of its caller."""
        inner = len(ConfigStack()) or any(map(_holds_compiled, data.signature.args))
        if not (inner or data.lifted or data.library.has_dynamic_globals):
            cache.write(self._file(sig, data.codegen), dumps(data._reduce()))

    def _file(self, sig: Any, codegen: Any) -> str:
        code = self._py_func.__code__
        name = self._py_func.__qualname__.replace("<", "").replace(">", "")
        key = hashlib.sha256(str(self._index_key(sig, codegen)).encode()).hexdigest()[:16]
        stem = Path(code.co_filename).stem
        return f"{self._folder}/{stem}.{name}-{code.co_firstlineno}.{key}.nbi"


def _holds_compiled(kind: NumbaType) -> bool:
    """Return True if the type of an argument is a compiled function, or has one as a part."""
    return isinstance(kind, types.Dispatcher) or any(
        map(_holds_compiled, getattr(kind, "types", ()))
    )


def stored(dispatcher: Any) -> Any:
    """Store the machine code of a function of the package on disk."""
    path = Path(inspect.getfile(dispatcher.py_func)).resolve()
    if path.is_relative_to(_PACKAGE):
        folder = path.relative_to(_PACKAGE).with_suffix("")
        dispatcher._cache = StoredCode(dispatcher.py_func, str(folder))
    return dispatcher


check_environment(numba.config.DISABLE_JIT)

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a function on its first call, with NumPy's rules for division by zero."""
    return _njit(function)


def called_from_python(function: F) -> F:
    """Compile a function that releases the interpreter's lock."""
    return _njit(function, nogil=True)


def _njit(function: F, *, nogil: bool = False) -> F:
    """Compile a function without liberties: it rounds as it is written, on every processor.

    A product and a sum are fused where they are written so (:mod:`dopt.kernel.vectors`). Numba
    hands a function the liberties of its caller unless ``fastmath`` is given, if only as False.
    """
    if plain.PLAIN:
        return function
    options = {"error_model": "numpy", "fastmath": False, "nogil": nogil}
    return cast(F, stored(numba.njit(**options)(function)))


def compilable(function: F) -> F:
    """Make a plain function, and its helpers in the same module, callable by compiled code."""
    for name in function.__code__.co_names:
        helper = function.__globals__.get(name)
        if isinstance(helper, FunctionType) and helper.__module__ == function.__module__:
            compilable(helper)
    register_jitable(error_model="numpy", fastmath=False)(function)
    return function


@compiled
def squared(x: float) -> float:
    """Return x², rounded by itself."""
    return x * x


@compiled
def copy_into(values: Vector, out: Vector) -> None:
    """Write values, (n,), to others; ``out[:] = values`` takes Numba two seconds to compile."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@plain.or_plain(plain.power_of_two)
@intrinsic
def power_of_two(typing_context: NumbaType, shifted: NumbaType) -> NumbaType:  # noqa: ARG001  # Numba's signature
    """Return 2^k for a float that holds the integer k in the lowest bits of its significand."""
    bits, exponent_at, bias = (32, 23, 127) if shifted == types.float32 else (64, 52, 1023)

    def generate(  # Numba's signature
        context: NumbaType,  # noqa: ARG001
        builder: NumbaType,
        signature: NumbaType,  # noqa: ARG001
        arguments: NumbaType,
    ) -> NumbaType:
        word = ir.IntType(bits)
        exponent = builder.shl(builder.bitcast(arguments[0], word), ir.Constant(word, exponent_at))
        biased = builder.add(exponent, ir.Constant(word, bias << exponent_at))
        return builder.bitcast(biased, arguments[0].type)

    return shifted(shifted), generate


@plain.or_plain(plain.monotonic_microseconds)
@intrinsic
def monotonic_microseconds(typing_context: NumbaType) -> NumbaType:  # noqa: ARG001  # Numba's signature
    """Read the system's monotonic clock [µs] (POSIX clock_gettime)."""
    monotonic = 6 if os.uname().sysname == "Darwin" else 1

    def generate(  # Numba's signature
        context: NumbaType,  # noqa: ARG001
        builder: NumbaType,
        signature: NumbaType,  # noqa: ARG001
        arguments: NumbaType,  # noqa: ARG001
    ) -> NumbaType:
        word = ir.IntType(64)
        timespec = ir.LiteralStructType([word, word])
        kind = ir.FunctionType(ir.IntType(32), [ir.IntType(32), timespec.as_pointer()])
        clock = cgutils.get_or_insert_function(builder.module, kind, "clock_gettime")
        slot = cgutils.alloca_once(builder, timespec)
        builder.call(clock, [ir.Constant(ir.IntType(32), monotonic), slot])
        seconds = builder.load(cgutils.gep_inbounds(builder, slot, 0, 0))
        nanoseconds = builder.load(cgutils.gep_inbounds(builder, slot, 0, 1))
        double = ir.DoubleType()
        return builder.fadd(
            builder.fmul(builder.sitofp(seconds, double), ir.Constant(double, 1e6)),
            builder.fmul(builder.sitofp(nanoseconds, double), ir.Constant(double, 1e-3)),
        )

    return types.float64(), generate


LIBRARIES = ("numpy", "math", "cmath", "builtins")
"""Modules whose functions change only with an installation."""

_SOURCES = tuple(f"dopt.{source.removesuffix('.py')}" for source in COMPILED_SOURCES)


def compiled_own(function: Callable[..., None], signature: NumbaType) -> CompiledFunction:
    """Return a function from a user's file, compiled for a signature or read from the cache."""
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
    for name in _names_read(function.__code__):
        if name in function.__globals__ and name not in seen:
            seen.add(name)
            value = function.__globals__[name]
            yield name, value
            helper = getattr(value, "py_func", value)  # also one that the user has compiled
            if isinstance(helper, FunctionType) and helper.__module__ == function.__module__:
                yield from _globals_of(helper, seen)


def _names_read(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_read(constant)


def _content(value: Any, own: str) -> str | None:
    """Return text that changes with a value in compiled code, None if there is no such text."""
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
