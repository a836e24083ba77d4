"""Analysis of a results database: data, statistics, tables, figures, reports and a browser.

``data`` reads, ``stats`` computes, ``tables`` and ``figures`` show. What a figure draws is saved as
CSV beside it. Notebooks begin with :func:`load`. :func:`read_log` reads recorded runs.

Each name is imported when it is first used: a program answers Ctrl-C before its libraries load.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.data.samples import Results as Results
    from analysis.data.samples import load as load
    from analysis.log_report import read_log as read_log

__all__ = ["Results", "load", "read_log"]


def _load(name: str) -> object:
    """Import a public name on its first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "analysis.log_report" if name == "read_log" else "analysis.data.samples"
    return getattr(importlib.import_module(module), name)


if not TYPE_CHECKING:  # a type checker would take every name for one that there is
    __getattr__ = _load  # PEP 562
