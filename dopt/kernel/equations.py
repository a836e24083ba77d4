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
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
from numba import complex128, float64, types
from numba.extending import overload
from numba.np.unsafe.ndarray import to_fixed_tuple

from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.compiler import compilable
from dopt.systems import elementary
from dopt.systems.base import System

KNOWN = types.void(float64[::1], float64[::1], float64[::1], float64[::1])
ACCELERATIONS = types.void(float64[::1], float64[::1], float64[::1])
COMPLEX_ACCELERATIONS = types.void(complex128[::1], complex128[::1], complex128[::1])


@overload(elementary.sin, strict=False)
def _sin(x: Any) -> Any:
    if isinstance(x, types.Complex):
        return lambda x: cmath.sin(x)
    return lambda x: math.sin(x)


@overload(elementary.cos, strict=False)
def _cos(x: Any) -> Any:
    if isinstance(x, types.Complex):
        return lambda x: cmath.cos(x)
    return lambda x: math.cos(x)


@overload(elementary.magnitude, strict=False)
def _magnitude(x: Any) -> Any:
    if isinstance(x, types.Complex):
        return lambda x: x if x.real >= 0 else -x
    return lambda x: abs(x)


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

    known: Any
    accelerations: Any
    complex_accelerations: Any


def compiled_equations(system: System) -> Equations:
    """Compile the equations of a system's class, or load them from the disk cache."""
    sizes = (system.n_states, system.n_inputs, len(system.physical))
    return _compiled_functions(system.known, system.accelerations, *sizes)


@functools.cache
def _compiled_functions(
    known: Callable[..., Any],
    accelerations: Callable[..., Any],
    n_states: int,
    n_inputs: int,
    n_parameters: int,
) -> Equations:
    name = f"{known.__module__}.{known.__qualname__}.{n_states}"
    known, accelerations = compilable(known), compilable(accelerations)
    with one_compiler_at_a_time(name):
        return Equations(
            _known_into(known, n_states, n_inputs, n_parameters),
            _accelerations_into(accelerations, n_states, n_parameters, ACCELERATIONS),
            _accelerations_into(accelerations, n_states, n_parameters, COMPLEX_ACCELERATIONS),
        )


def _known_into(
    function: Callable[..., Any], n_states: int, n_inputs: int, n_parameters: int
) -> Any:
    def into(x: Any, u: Any, p: Any, out: Any) -> None:
        values = function(
            to_fixed_tuple(x, n_states),
            to_fixed_tuple(u, n_inputs),
            to_fixed_tuple(p, n_parameters),
        )
        for i in range(len(values)):
            out[i] = values[i]

    return _compiled_for(function, into, KNOWN, n_states)


def _accelerations_into(
    function: Callable[..., Any], n_states: int, n_parameters: int, signature: Any
) -> Any:
    def into(x: Any, p: Any, out: Any) -> None:
        values = function(to_fixed_tuple(x, n_states), to_fixed_tuple(p, n_parameters))
        for i in range(len(values)):
            out[i] = values[i]

    return _compiled_for(function, into, signature, n_states)


def _compiled_for(
    function: Callable[..., Any], into: Callable[..., None], signature: Any, n_states: int
) -> Any:
    """Compile ``into`` under a name of its own.

    Numba tells functions of one name apart by a number that starts anew in each process. Two of
    them that were cached by different processes, or one cached and one compiled here, would share a
    symbol, and a call of one could run the other. One equation may serve several numbers of states.
    """
    own = function.__module__.startswith("dopt.systems.")
    name = f"{function.__module__}.{function.__qualname__}.{n_states}"
    into.__qualname__ = name if own else f"{name}.{next(_foreign)}"
    into.__name__ = into.__qualname__.replace(".", "_").replace("<", "_").replace(">", "_")
    # The cache's folder is named after the package's sources: only they may be found in it.
    return numba.njit(signature, cache=own, error_model="numpy")(into)


_foreign = itertools.count()
