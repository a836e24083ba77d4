"""From the results database to numbers, from numbers to tables and pictures.

Reading (``selection``, ``reading``), numbers (``statistics``, ``paired``, ``spectrum``, ``phase``,
``coverage``) and ink (``figures``) are strictly apart: what is drawn is saved as CSV beside it.
Notebooks begin with :func:`load`.
"""

from __future__ import annotations

from analysis.loading import Results, load

__all__ = ["Results", "load"]
