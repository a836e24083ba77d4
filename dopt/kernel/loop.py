"""The loop of a trial and the search of its plans, compiled for function pointers.

Each is compiled once for all systems. The search, which takes as long to compile as all the rest,
is so only where a policy needs it.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numba
from numba import float64, int64, types

from dopt.kernel.arguments import SEARCH
from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.equations import ACCELERATIONS, COMPLEX_ACCELERATIONS, KNOWN
from dopt.kernel.search import no_search, search_input
from dopt.kernel.trial import advance


def compiled_loop(call: tuple[Any, ...]) -> Any:
    """Return the loop for the arguments of a trial from World to Record."""
    equations = (pointer(KNOWN), pointer(ACCELERATIONS), pointer(COMPLEX_ACCELERATIONS))
    kinds = tuple(numba.typeof(argument) for argument in call)
    search = pointer(types.void(*_search_kinds(call)))
    return compiled_for("loop", advance, (*equations, search, *kinds, int64, int64))


def compiled_search(call: tuple[Any, ...]) -> Any:
    """Return the search for the same arguments; one that finds nothing if none is needed."""
    rules = call[2]
    if rules.policy == SEARCH:
        return compiled_for("search", search_input, _search_kinds(call))
    return compiled_for("no-search", no_search, _search_kinds(call))


def _search_kinds(call: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the types of the search's arguments."""
    world, network, rules, _, _, state, _ = call
    given = (world, network, rules.search, state.theta, state.covariance)
    kinds = (numba.typeof(argument) for argument in given)
    return (pointer(KNOWN), pointer(ACCELERATIONS), *kinds, *(float64[::1],) * 3)


def pointer(signature: Any) -> Any:
    """Return the type of a pointer to functions of a signature."""
    return types.FunctionType(signature)


def compiled_for(name: str, function: Any, kinds: tuple[Any, ...]) -> Any:
    """Compile a function for types of arguments, unless it is."""
    if (name, kinds) not in _done:
        with one_compiler_at_a_time(
            f"{name}-{hashlib.sha256(str(kinds).encode()).hexdigest()[:16]}"
        ):
            function.compile(kinds)
        function.disable_compile()
        _done.add((name, kinds))
    return function


_done: set[tuple[str, tuple[Any, ...]]] = set()
