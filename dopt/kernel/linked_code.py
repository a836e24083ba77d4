"""Compilation of functions that only other compiled functions call, as far as to LLVM code.

Numba makes machine code and a wrapper for Python of every function that a compilation needs, with
all functions below it, although the code of the outermost one holds them already. Here a function
that is compiled on the way is optimized and handed to its caller. (To leave the optimization to the
caller as well saves as much again, but changes the last bits of some sums.) A function that Python
calls after all is compiled again.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.environment import lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import ConfigStack


def within_a_compilation() -> bool:
    """Return whether Numba compiles another function at the moment."""
    return len(ConfigStack()) > 0


class _Library(JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """Code of a function; callers get it as it is before the making of machine code changes it."""

    only_linked = False

    def _finalize_final_module(self) -> None:
        self._finalized = True
        self._get_module_for_linking()
        if self.only_linked:
            self._finalize_dynamic_globals()
        else:
            super()._finalize_final_module()


class _Steps(Compiler):  # type: ignore[misc]
    """Numba's steps, without the last ones where another function is compiled."""

    def compile_extra(self, func: Any) -> Any:
        library = _Library(self.state.targetctx.codegen(), func.__qualname__)
        library.enable_object_caching()
        self.state.library = library
        if within_a_compilation():
            library.only_linked = True
            flags = self.state.flags
            flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        return super().compile_extra(func)


class _OnlyLinked:
    """What stands for the entry point of a function that has none."""


class LinkedDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Compiled function that has machine code of its own only where Python calls it."""

    def __init__(
        self,
        py_func: Any,
        locals: Any = None,  # the name is Numba's
        targetoptions: Any = None,
        pipeline_class: Any = _Steps,
    ) -> None:
        super().__init__(py_func, locals, targetoptions, pipeline_class)

    def compile(self, sig: Any) -> Any:
        found = super().compile(sig)
        if within_a_compilation() or not isinstance(found, _OnlyLinked):
            return found
        given = next(kinds for kinds, one in self.overloads.items() if one.entry_point is found)
        del self.overloads[given]
        return super().compile(sig)

    def get_compile_result(self, sig: Any) -> Any:
        if not within_a_compilation():
            self.compile(sig)
        return super().get_compile_result(sig)

    def add_overload(self, result: Any) -> None:
        if result.entry_point is None:
            result = result._replace(entry_point=_OnlyLinked())
            self.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
            self.overloads[tuple(result.signature.args)] = result
            return
        super().add_overload(result)
        codegen = self.targetctx.codegen()
        for variable in result.library._final_module.global_variables:
            environment = lookup_environment(variable.name)
            if environment is not None:
                codegen.set_env(variable.name, environment)
