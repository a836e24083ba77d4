"""Machine code of the outermost functions alone, in a process that only fills the cache.

Numba optimizes each function that it compiles, and makes machine code of it, also where only other
compiled functions call it, whose code holds it already and is optimized as a whole: about half of
the time. A process that calls nothing that it compiles can do without. Callers come out smaller,
and their numbers are the same, up to the rounding of sums that may be taken in any order.
"""

from __future__ import annotations

from typing import Any

from numba import _dynfunc
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.targetconfig import ConfigStack

_optimize = CPUCodeLibrary._optimize_final_module
_finish = CPUCodeLibrary._finalize_final_module
_executable = CPUContext.get_executable


def leave_callees_out() -> None:
    """Skip separate optimisation of functions compiled only as callees.

    There is no machine code of it either: Python must not call such a function in this process.
    """
    CPUCodeLibrary._optimize_final_module = _optimize_outermost
    CPUCodeLibrary._finalize_final_module = _finish_outermost
    CPUContext.get_executable = _executable_of_outermost


def _is_callee() -> bool:
    """Return True if the compilation of another function asked for the present one."""
    return len(ConfigStack()) > 1


def _optimize_outermost(library: Any) -> None:
    """Optimize a library; not a callee's, which is optimized as part of its callers.

    A callee that takes liberties with rounding is optimized: which products and sums are fused
    would otherwise depend on what surrounds them in a caller.
    """
    if not _is_callee() or ConfigStack().top().fastmath:
        _optimize(library)


def _finish_outermost(library: Any) -> None:
    """Hand a library to the compiler's back end; a callee's is only linked into its callers'."""
    if not _is_callee():
        _finish(library)
        return
    library._finalize_dynamic_globals()
    library._verify_declare_only_symbols()
    library._finalized = True


def _executable_of_outermost(context: Any, library: Any, described: Any, env: Any) -> Any:
    """Return what Python calls; of a callee an object without code by which Numba knows it."""
    if not _is_callee():
        return _executable(context, library, described, env)
    library._ensure_finalized()
    name, nowhere = described.qualname.rpartition(".")[-1], 0
    module = described.lookup_module()
    return _dynfunc.make_function(module, name, "", nowhere, env, (library,))
