"""Decorators that compile functions of the kernel, and operations that only the compiler has."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import FunctionType
from typing import TypeVar, cast

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

from dopt.kernel import plain
from dopt.kernel.cache import check_environment
from dopt.kernel.stored_code import stored
from dopt.types import NumbaType, Vector

check_environment(numba.config.DISABLE_JIT)

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a function on its first call, with NumPy's rules for division by zero."""
    return _njit(function)


def called_from_python(function: F) -> F:
    """Compile a function during which other threads of the interpreter run."""
    return _njit(function, nogil=True)


def contracted(function: F) -> F:
    """Compile a function whose products and sums may be fused: a·b + c rounds once.

    Write x·x with :func:`squared`: Numba compiles the operator ``**`` as a function of its own,
    with the liberties of whichever function uses it first in a process.
    """
    return _njit(function, fastmath={"contract"})


def vectorized(function: F) -> F:
    """Compile a function whose sums may also be taken in another order, as vector lanes need."""
    return _njit(function, fastmath={"contract", "reassoc"})


def _njit(function: F, *, fastmath: bool | set[str] = False, nogil: bool = False) -> F:
    """Compile a function whose rounding does not depend on which function calls it first.

    Numba compiles a function once, and hands it the liberties of the caller for which it does so
    unless ``fastmath`` is given, if only as False.
    """
    if plain.PLAIN:
        return function
    options = {"error_model": "numpy", "fastmath": fastmath, "nogil": nogil}
    return cast(F, stored(numba.njit(**options)(function)))


def compilable(function: F) -> F:
    """Let compiled code call a plain function and the helpers that it uses from its own module."""
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
def power_of_two(typing_context: NumbaType, shifted: NumbaType) -> NumbaType:  # noqa: ARG001  # the signature is that of Numba
    """Return 2^k for a float that holds the integer k in the lowest bits of its significand."""
    bits, exponent_at, bias = (32, 23, 127) if shifted == types.float32 else (64, 52, 1023)

    def generate(  # the signature is that of numba
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
def monotonic_microseconds(typing_context: NumbaType) -> NumbaType:  # noqa: ARG001  # the signature is that of Numba
    """Read the system's monotonic clock [µs] (POSIX clock_gettime)."""
    monotonic = 6 if os.uname().sysname == "Darwin" else 1

    def generate(  # the signature is that of numba
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
