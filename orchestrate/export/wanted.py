"""Kinds and formats of exports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dopt.errors import DoptError

KINDS = ("curves", "trials", "trajectories", "assessments")
"""Exports that are one file."""

FOLDERS = ("bundle", "mlflow", "wandb")
"""Exports that are a folder."""

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


@dataclass(frozen=True)
class FolderExport:
    """Request of an export: one of ``FOLDERS``, with filters.

    ``license`` is the identifier of the licence of the data, written into the card of a bundle.
    """

    kind: str
    out: Path
    filters: Mapping[str, Sequence[str]]
    license: str
