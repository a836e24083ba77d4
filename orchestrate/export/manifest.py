"""Manifest of an export: the origin of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from dopt import __version__
from orchestrate.queries.status import counts
from orchestrate.redaction import without_password
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.serialization import now

_WRITERS = "SELECT DISTINCT config_key, launch_id FROM v_trial WHERE launch_id IS NOT NULL"


def provenance(
    reader: Reader, configs: Sequence[ConfigRow], filters: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return database, selection, configurations and launches, without passwords."""
    keys = {config.config_key for config in configs}
    writers = {row.launch_id for row in reader.rows(_WRITERS) if row.config_key in keys}
    launches = [asdict(one) for one in reader.launches() if one.launch_id in writers]
    return {
        "written": now(),
        "program": f"dopt {__version__}",
        "database": reader.safe_url,
        "schema_version": reader.schema_version(),
        "filters": {name: list(values) for name, values in filters.items()},
        "trials": dict(counts(configs)),
        "missing_values": "empty in csv, null in parquet, NaN in npz: a loss that is not finite",
        "configs": {config.config_key: dict(config.config) for config in configs},
        "launches": [_public(launch) for launch in launches],
    }


def _public(launch: Mapping[str, Any]) -> dict[str, Any]:
    words = {name: [*map(without_password, launch[name])] for name in ("argv", "overrides")}
    return {**launch, **words}
