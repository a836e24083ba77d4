"""Environment of worker processes: the module path of the launch, and one thread.

With one thread for each process the workers share the cores, and sums keep their order.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path

ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)

_PACKAGE = __name__.partition(".")[0]


def pin_threads() -> None:
    """Pin the numerical libraries of this process, and of those it starts, to one thread.

    The variables act on libraries that are imported later; a loaded torch is set directly.
    """
    os.environ.update(ONE_THREAD)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def module_path() -> dict[str, str]:
    """Return the environment in which another interpreter finds the modules that this one finds.

    A folder with another ``orchestrate``, such as a user's script of that name, comes last.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = [path for path in sys.path if path]
    first = [] if root in paths else [root]  # an installed copy stays after the standard library
    paths.sort(key=lambda path: path != root and PathFinder.find_spec(_PACKAGE, [path]) is not None)
    return {"PYTHONPATH": os.pathsep.join([*first, *paths])}
