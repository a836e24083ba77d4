"""Exports that are a folder: which function writes each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from orchestrate.export.wanted import FolderExport
from orchestrate.store import ConfigRow, Reader


def export_folder(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport
) -> dict[str, Any]:
    """Write the folder, whole or not at all; return what is said of it.

    ``reader`` sees one moment, that of ``configs``. Raises ``ExportError``, or ``OutputError`` if
    it cannot be written.
    """
    # Each needs libraries that the others do not.
    if wanted.kind == "mlflow":
        from orchestrate.export.trackers.mlflow_store import write_mlflow

        return write_mlflow(reader, configs, wanted)
    if wanted.kind == "wandb":
        from orchestrate.export.trackers.wandb_offline import write_wandb

        return write_wandb(reader, configs, wanted)
    from orchestrate.export.bundle.writing import write_bundle

    return write_bundle(reader, configs, wanted)
