"""Kinds and formats of exports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dopt.errors import DoptError

KINDS = ("curves", "trials", "trajectories", "assessments")
FORMATS = ("csv", "parquet", "npz")


class ExportError(DoptError):
    """Empty selection, or file that cannot be written."""


@dataclass(frozen=True)
class Export:
    """Request of an export: one of ``KINDS`` in one of ``FORMATS``, with filters."""

    kind: str
    format: str
    out: Path
    filters: Mapping[str, Sequence[str]]

    @property
    def manifest(self) -> Path:
        return self.out.with_name(f"{self.out.name}.manifest.json")
