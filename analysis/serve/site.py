"""What every page needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from analysis.choice import Filter
from analysis.selection import Selection, select
from analysis.serve.memory import Memory
from analysis.serve.progress import measure
from analysis.serve.source import Source
from orchestrate.store import Reader


@dataclass(frozen=True)
class Site:
    """The database, the folder of figures, and what was computed already."""

    source: Source
    figures: Path
    memory: Memory = field(default_factory=Memory)
    selections: Memory = field(default_factory=lambda: Memory(4))  # each holds all its trials

    def select(self, reader: Reader, wanted: Filter) -> Selection:
        """Return the trials that are asked for, read anew where any trial changed."""
        key = ("selection", reader, measure(reader)["token"], repr(wanted))
        return self.selections.recall(key, lambda: select(reader, wanted))
