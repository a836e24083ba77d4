"""How the kernel is compiled: once per source and machine, cached on disk, shared by processes."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import llvmlite.binding
import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

F = TypeVar("F", bound=Callable[..., Any])

CACHE_VARIABLE = "DOPT_CACHE"
_PACKAGE = Path(__file__).resolve().parent.parent
_COMPILED_SOURCES = ("kernel", "systems", "planning")


def _source_digest() -> str:
    """Return a digest of every source that ends up in compiled code.

    Numba checks only the file of the outermost function of what it finds in its cache, so a change
    in a file further in would go unnoticed: each state of the sources, and each kind of processor,
    gets a folder of its own.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    digest.update(llvmlite.binding.get_host_cpu_name().encode())
    for folder in _COMPILED_SOURCES:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a writable folder for compiled code."""
    base = os.environ.get(CACHE_VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    root = Path(base) if base else Path.home() / ".cache"
    folder = root / "dopt" / f"kernel-{_source_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="dopt-kernel-"))


CACHE_FOLDER = _cache_folder()
numba.config.CACHE_DIR = str(CACHE_FOLDER)


@contextlib.contextmanager
def one_compiler_at_a_time(what: str) -> Iterator[None]:
    """Let one process at a time put ``what`` into the cache; once it is there, all read freely.

    Numba numbers the files of its cache without a lock: of two processes that compile at once, one
    can overwrite the other's function, and later processes then run the wrong one.
    """
    complete = CACHE_FOLDER / f"{what}.complete"
    if complete.exists():
        yield
        return
    with (CACHE_FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
        complete.touch()


def compiled(function: F) -> F:
    """Compile a function on its first call, with NumPy's rules for division by zero."""
    return _njit(function)


def contracted(function: F) -> F:
    """Compile a function whose products and sums may be fused: a·b + c rounds once."""
    return _njit(function, fastmath={"contract"})


def vectorized(function: F) -> F:
    """Compile a function whose sums may also be taken in another order, as vector lanes need."""
    return _njit(function, fastmath={"contract", "reassoc"})


def _njit(function: F, **options: Any) -> F:
    return cast(F, numba.njit(cache=True, error_model="numpy", **options)(function))


def compilable(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let compiled code call a plain function and the helpers that it uses from its own module."""
    for name in function.__code__.co_names:
        helper = function.__globals__.get(name)
        if isinstance(helper, FunctionType) and helper.__module__ == function.__module__:
            compilable(helper)
    register_jitable(function)
    return function


@intrinsic
def power_of_two(typing_context: Any, shifted: Any) -> Any:  # noqa: ARG001
    """Return 2^k for a float that holds the integer k in the lowest bits of its significand."""
    bits, exponent_at, bias = (32, 23, 127) if shifted == types.float32 else (64, 52, 1023)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        word = ir.IntType(bits)
        exponent = builder.shl(builder.bitcast(arguments[0], word), ir.Constant(word, exponent_at))
        biased = builder.add(exponent, ir.Constant(word, bias << exponent_at))
        return builder.bitcast(biased, arguments[0].type)

    return shifted(shifted), generate


@intrinsic
def monotonic_microseconds(typing_context: Any) -> Any:  # noqa: ARG001
    """Read the system's monotonic clock [µs] (POSIX clock_gettime)."""
    monotonic = 6 if os.uname().sysname == "Darwin" else 1

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
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
