"""Analysis of a results database: data, statistics, tables, figures, reports and a browser.

``data`` reads, ``stats`` computes, ``tables`` and ``figures`` show. What a figure draws is saved as
CSV beside it. Notebooks begin with :func:`load`. :func:`read_log` reads recorded runs.
"""

from __future__ import annotations

from analysis.data.samples import Results, load
from analysis.log_report import read_log

__all__ = ["Results", "load", "read_log"]
