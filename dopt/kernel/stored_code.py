"""Disk cache of compiled functions, found by what the sources say and not by where they lie.

Numba looks for machine code under the path of its source, and stores a function each time that it
compiles one, also one that only another function calls, whose code holds it already. Here the
folder is that of a state of the sources (:mod:`dopt.kernel.cache`), the same for every checkout on
a machine, and what another function's compilation needed is not stored once more.

Nor is code for arguments that are compiled functions themselves, as in a test that hands a plant
to a function of the kernel: the entry would hold the argument, and whoever opens the file would
compile it. A trial hands over pointers.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.runtime import rtsys
from numba.core.targetconfig import ConfigStack

from dopt.kernel.cache import CACHE_FOLDER
from dopt.types import NumbaType

_PACKAGE = Path(__file__).resolve().parents[1]


class Place(_CacheLocator):  # type: ignore[misc]  # numba has no types
    """Folder of a function's machine code, named by its file's path within the package."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # a warning of numba's names it
        self._line = function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        path = Path(self._py_file).resolve().relative_to(_PACKAGE)
        return str(CACHE_FOLDER / path.with_suffix(""))

    def get_source_stamp(self) -> str:
        return hashlib.sha256(Path(self._py_file).read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Self:
        place = cls(py_func, py_file)
        place.ensure_cache_path()
        return place


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (Place,)


class StoredCode(FunctionCache):  # type: ignore[misc]
    """Machine code of one function of the package for each of its signatures."""

    _impl_class = _Implementation

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is stored without first loading all that Numba can compile.

        Numba's own method does that, for 0.15 s in each process; its compiler does so too, where
        there is something to compile. Machine code needs the runtime library alone.
        """
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a function that Python calls; one compiled on the way is part of its caller."""
        if not len(ConfigStack()) and not any(map(_holds_compiled, data.signature.args)):
            super().save_overload(sig, data)


def _holds_compiled(kind: NumbaType) -> bool:
    """Tell whether the type of an argument is that of a compiled function, or has it as a part."""
    return isinstance(kind, types.Dispatcher) or any(
        map(_holds_compiled, getattr(kind, "types", ()))
    )


def stored(dispatcher: Any) -> Any:
    """Let a compiled function keep its machine code on disk, if the package's sources hold it."""
    if Path(inspect.getfile(dispatcher.py_func)).resolve().is_relative_to(_PACKAGE):
        dispatcher._cache = StoredCode(dispatcher.py_func)
    return dispatcher
