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
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import types
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.targetconfig import ConfigStack

from dopt.kernel import cache
from dopt.types import NumbaType

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
    """Tell whether the type of an argument is that of a compiled function, or has it as a part."""
    return isinstance(kind, types.Dispatcher) or any(
        map(_holds_compiled, getattr(kind, "types", ()))
    )


def stored(dispatcher: Any) -> Any:
    """Let a compiled function keep its machine code on disk, if the package's sources hold it."""
    path = Path(inspect.getfile(dispatcher.py_func)).resolve()
    if path.is_relative_to(_PACKAGE):
        folder = path.relative_to(_PACKAGE).with_suffix("")
        dispatcher._cache = StoredCode(dispatcher.py_func, str(folder))
    return dispatcher
