"""The equations of a system as compiled functions that write into arrays.

The very functions of :mod:`dopt.systems` are compiled, for float64 and, where a complex step takes
their derivative, for complex128. The kernel calls them through pointers, so that it is compiled
once for all systems.
"""

from __future__ import annotations

import cmath
import functools
import itertools
import math
import operator
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numba
from numba import complex128, float64, types
from numba.extending import overload
from numba.np.unsafe.ndarray import to_fixed_tuple

from dopt.errors import SpecificationError
from dopt.kernel.cache import errors_of_the_system, one_compiler_at_a_time
from dopt.kernel.compiler import compilable, stored
from dopt.kernel.plain import PLAIN
from dopt.systems import elementary
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox, unknown_accelerations
from dopt.types import Array, CompiledFunction, Equation, NumbaType, Scalar

as_tuple = (lambda values, _: tuple(values)) if PLAIN else to_fixed_tuple

KNOWN = types.void(float64[::1], float64[::1], float64[::1], float64[::1])
ACCELERATIONS = types.void(float64[::1], float64[::1], float64[::1])
COMPLEX_ACCELERATIONS = types.void(complex128[::1], complex128[::1], complex128[::1])


@overload(elementary.sin, strict=False)
def _sin(x: NumbaType) -> NumbaType:
    if isinstance(x, types.Complex):
        return lambda x: cmath.sin(x)
    return lambda x: math.sin(x)


@overload(elementary.cos, strict=False)
def _cos(x: NumbaType) -> NumbaType:
    if isinstance(x, types.Complex):
        return lambda x: cmath.cos(x)
    return lambda x: math.cos(x)


@overload(elementary.tanh, strict=False)
def _tanh(x: NumbaType) -> NumbaType:
    if isinstance(x, types.Complex):
        return lambda x: cmath.tanh(x)
    return lambda x: math.tanh(x)


@overload(elementary.magnitude, strict=False)
def _magnitude(x: NumbaType) -> NumbaType:
    if isinstance(x, types.Complex):
        return lambda x: x if x.real >= 0 else -x
    return lambda x: abs(x)


@overload(elementary.sign, strict=False)
def _sign(x: NumbaType) -> NumbaType:  # noqa: ARG001  # the function's signature
    return lambda x: math.nan if math.isnan(x.real) else float((x.real > 0) - (x.real < 0))


@overload(elementary.where, strict=False)
def _where(condition: NumbaType, first: NumbaType, second: NumbaType) -> NumbaType:  # noqa: ARG001
    return lambda condition, first, second: first if condition else second


def _compare_real_parts(compare: Callable[[Scalar, Scalar], Scalar]) -> None:
    """Define comparisons of complex numbers in compiled equations, by their real parts."""

    def of_real_parts(a: Scalar, b: Scalar) -> Scalar:
        return compare(a.real, b.real)

    # Four functions of one name could share a symbol in the code of different processes.
    of_real_parts.__qualname__ = of_real_parts.__name__ = f"{compare.__name__}_of_real_parts"

    @overload(compare, strict=False)
    def _compare(a: NumbaType, b: NumbaType) -> NumbaType:
        return of_real_parts if any(isinstance(x, types.Complex) for x in (a, b)) else None


for _comparison in (operator.gt, operator.ge, operator.lt, operator.le):
    _compare_real_parts(_comparison)


class Equations(NamedTuple):
    """Compiled equations of one class of systems, each writing into its last argument.

    Attributes
    ----------
    known : (x, u, p, out)
        Known part of dx/dt.
    accelerations : (x, p, out)
        Learned accelerations.
    complex_accelerations : (x, p, out)
        The same for complex arguments.
    """

    known: CompiledFunction
    accelerations: CompiledFunction
    complex_accelerations: CompiledFunction


def compiled_equations(system: System) -> Equations:
    """Compile the equations of a system's class, or load them from the disk cache.

    The accelerations of a black box are NaN.
    """
    read = system.n_inputs if system.reads_inputs else 0
    sizes = (system.n_states, system.n_inputs, len(system.physical), read)
    unknown = isinstance(system, BlackBox)
    accelerations = unknown_accelerations(system.n_learned) if unknown else system.accelerations
    return _compiled_functions(system.known, accelerations, *sizes)


def name_of_equations(system: System) -> str:
    """Return the name in the cache of the compiled equations of a system's class."""
    return _name(system.known, system.n_states)


def _name(known: Equation, n_states: int) -> str:
    return f"equations of {known.__module__}.{known.__qualname__}.{n_states}"


@functools.cache
def _compiled_functions(
    known: Equation,
    accelerations: Equation,
    n_states: int,
    n_inputs: int,
    n_parameters: int,
    n_inputs_read: int,
) -> Equations:
    name, n_read = _name(known, n_states), n_states + n_inputs_read
    known, accelerations = compilable(known), compilable(accelerations)
    stored_once = _shipped(known) and not PLAIN
    with one_compiler_at_a_time(name) if stored_once else errors_of_the_system():
        return Equations(
            _known_into(known, n_states, n_inputs, n_parameters),
            _accelerations_into(accelerations, n_read, n_parameters, ACCELERATIONS),
            _accelerations_into(accelerations, n_read, n_parameters, COMPLEX_ACCELERATIONS),
        )


def _refused(function: Equation, sizes: tuple[int, ...], kind: NumbaType) -> SpecificationError:
    """Return the sentence for an equation that does not compile: which line, and the reason."""
    file, place, reason = Path(function.__code__.co_filename).name, "", "its helpers fail"
    try:
        numba.njit(function).compile(tuple(types.UniTuple(kind, size) for size in sizes))
    except Exception as error:
        text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
        lines = re.findall(rf"{re.escape(file)}\W+(?:line )?(\d+)", text)
        place = f" at line {lines[-1]}" if lines else ""
        calls = re.findall(r"^\s*>>> (.*)$", text, re.MULTILINE)
        said = [line for line in text.splitlines() if line and "nopython mode" not in line]
        reason = f"nothing compiled for {calls[0]}" if calls else said[0].rstrip(" :.")
    return SpecificationError(
        f"{function.__qualname__} of {file} does not compile{place} ({reason}), but sums, "
        f"products, comparisons and the functions of dopt.systems.elementary are expected: write "
        f"it with these, or declare compiled = False in the class, whose trials then run in torch "
        f"where it has the policy."
    )


def _known_into(
    function: Equation, n_states: int, n_inputs: int, n_parameters: int
) -> CompiledFunction:
    def into(x: Array, u: Array, p: Array, out: Array) -> None:
        values = function(as_tuple(x, n_states), as_tuple(u, n_inputs), as_tuple(p, n_parameters))
        for i in range(len(values)):
            out[i] = values[i]

    return _compiled_for(function, into, KNOWN, (n_states, n_inputs, n_parameters))


def _accelerations_into(
    function: Equation, n_read: int, n_parameters: int, signature: NumbaType
) -> CompiledFunction:
    def into(x: Array, p: Array, out: Array) -> None:
        values = function(as_tuple(x, n_read), as_tuple(p, n_parameters))
        for i in range(len(values)):
            out[i] = values[i]

    return _compiled_for(function, into, signature, (n_read, n_parameters))


def _compiled_for(
    function: Equation, into: Callable[..., None], signature: NumbaType, sizes: tuple[int, ...]
) -> CompiledFunction:
    """Compile ``into`` under a name of its own.

    Numba tells functions of one name apart by a number that restarts in each process. Two of
    them that were cached by different processes, or one cached and one compiled here, would share a
    symbol, and a call of one could run the other. One equation may serve several numbers of states.
    """
    own = _shipped(function)
    name = f"{function.__module__}.{function.__qualname__}.{sizes[0]}"
    into.__qualname__ = name if own else f"{name}.{next(_foreign)}"
    into.__name__ = into.__qualname__.replace(".", "_").replace("<", "_").replace(">", "_")
    if PLAIN:
        return into
    compiled = numba.njit(error_model="numpy", fastmath=False)(into)
    if own:  # the cache's folder is named after the package's sources: only they belong in it
        stored(compiled)
    try:
        compiled.compile(signature.args)
    except (OSError, MemoryError):
        raise  # the system's, not an equation's
    except Exception as error:  # also what the compiler raises on Python that it does not know
        raise _refused(function, sizes, signature.args[0].dtype) from error
    compiled.disable_compile()
    return compiled


def _shipped(function: Equation) -> bool:
    return function.__module__.startswith("dopt.systems.")


_foreign = itertools.count()
