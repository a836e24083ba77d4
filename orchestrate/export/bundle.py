"""Bundle of results: tables, views, card, provenance and checksums in one folder.

The Parquet files have the encodings that were measured to be the smallest. On the 1,900 trials of
the paper, zstd leaves 80 to 87 % of the bytes of losses, states and parameters when the bytes of
the numbers are split into streams, and 94 to 97 % without. Times of steps, which repeat, take a
fifth with a dictionary and two fifths with streams.
"""

from __future__ import annotations

import json
import platform
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from orchestrate.errors import without_password
from orchestrate.export.exporting import BundleExport, ExportError, provenance
from orchestrate.export.tables import gathered
from orchestrate.files import whole_folder
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.bundle import (
    ARRAY_AXES,
    KIND,
    PROVENANCE,
    TABLES,
    arrow_schema,
    file_name,
    primary_key,
    write_checksums,
)
from orchestrate.store.records import unpack
from orchestrate.store.schema import OUTCOME, RUN_COLUMNS, VIEWS

CARD = "README.md"

_LIBRARIES = ("numpy", "pyarrow", "sqlalchemy")

VIEWS_FILE = "views.sql"

_HEAD = """\
-- Tables and views of these results for DuckDB, in the folder of the bundle:
--   duckdb -init views.sql
-- or, from anywhere, SET file_search_path = 'FOLDER' before.

-- Whole numbers are divided as in SQLite and PostgreSQL: 3 / 2 = 1.
SET integer_division = true;

"""

_GROUP_BYTES = 2**25
"""Bytes in memory of the rows that are compressed together."""

_SPLIT = ("loss", "reachable_loss", "value")
"""Columns of numbers that hardly ever repeat."""

ROWS = 50_000
"""Rows of a table in one batch; of trajectories, which are long, a hundredth."""

_TRIALS = "JOIN trial ON trial.config_id = config.config_id"
_JOINS = {
    "config": "",
    "trial": _TRIALS,
    **{
        name: f"{_TRIALS} JOIN {name} ON {name}.trial_id = trial.trial_id"
        for name in ("step", "trajectory", "assessment", "attempt")
    },
}
"""Joins of each table with ``config``, of which some rows are selected."""

_REFERENCES = {
    "launch": (
        *(("trial", name) for name in ("owner", "launch_id", "registered_by")),
        ("attempt", "launch_id"),
    ),
    "error": (("trial", "error_id"), ("attempt", "error_id")),
}
"""Columns that refer to the rows of a table."""

_TEXTS_OF_USERS = ("argv", "overrides", "message", "traceback")
"""Columns in which a password could stand."""

_CITATION = """\
```bibtex
@inproceedings{blanke2022doptimal,
  author={Blanke, Matthieu and Lelarge, Marc},
  title={{D}-optimal neural exploration of nonlinear physical systems},
  booktitle={Machine Learning and the Physical Sciences, {NeurIPS} workshop},
  year={2022},
  url={https://ml4physicalsciences.github.io/2022/files/NeurIPS_ML4PS_2022_37.pdf}
}
```
"""
_LOADING = """\
Check the files with `sha256sum --check SHA256SUMS`. FOLDER is the folder of this card.

With dopt, which imports a bundle into a database:

```bash
python -m orchestrate merge FOLDER --db sqlite:///results/bundle.db
python -m analysis figures --db sqlite:///results/bundle.db --out figures
```

```python
import analysis

results = analysis.load("sqlite:///results/bundle.db")
results.curves("loss")
```

With pandas:

```python
import pandas as pd

trials = pd.read_parquet("FOLDER/trial.parquet").merge(
    pd.read_parquet("FOLDER/config.parquet"), on="config_id"
)
losses = pd.read_parquet("FOLDER/step.parquet", columns=["trial_id", "t", "loss"])
```

With DuckDB, in this folder:

```bash
duckdb -init views.sql
```

```sql
SELECT env, policy, label, avg(final_loss) AS mean FROM v_trial WHERE status = 'done' GROUP BY ALL;
```
"""
_SIZES = (
    (1e3, "n<1K"),
    (1e4, "1K<n<10K"),
    (1e5, "10K<n<100K"),
    (1e6, "100K<n<1M"),
    (1e7, "1M<n<10M"),
)

TABLE_TITLES: Mapping[str, str] = {
    "config": "one row for each configuration: all that defines a trial but its seed",
    "trial": "one row for each trial: a configuration with a seed",
    "step": "one row for each step of each finished trial",
    "trajectory": "one row for each finished trial: its arrays",
    "assessment": "one row for each measure of a finished trial: of a task, limits or samples",
    "launch": "one row for each command that ran trials",
    "attempt": "one row for each run of a trial, lost runs included",
    "error": "one row for each distinct traceback",
}
"""In the order of the card."""

_TRIAL_ID = ("", "trial, a row of `trial`")
_LAUNCH_ID = ("", "launch, a row of `launch`")
_ERROR_ID = ("", "error, a row of `error`")
_OUTCOME = {name: (one.unit, one.meaning) for name, one in OUTCOME.items()}

COLUMNS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "config": {
        "config_id": ("", "number of the configuration in this bundle"),
        "config_key": ("", "SHA-256 of `config_json`"),
        "env": ("", "system"),
        "policy": ("", "policy that chooses the inputs"),
        "model": ("", "model that is learned"),
        "learner": ("", "rule that updates the parameters of the model"),
        "width": ("units", "width of the hidden layers"),
        "depth": ("layers", "number of hidden layers"),
        "horizon": ("steps", "number of steps of a trial"),
        "dt": ("s", "duration of a step"),
        "gamma": ("unit of the input", "bound of the norm of an input"),
        "config_json": ("", "the whole configuration, without the fields that have the defaults"),
        "label": ("", "the policy, and every setting that is not the default"),
    },
    "trial": {
        "trial_id": ("", "number of the trial in this bundle"),
        "trial_key": ("", "SHA-256 of configuration and seed"),
        "config_id": ("", "configuration, a row of `config`"),
        "seed": ("", "seed of all random numbers of the trial"),
        "status": ("", "pending, running, done, diverged, failed or cancelled"),
        "owner": ("", "launch that runs the trial"),
        "attempt": ("", "number of runs"),
        **_OUTCOME,
        "launch_id": _LAUNCH_ID,
        "error_id": _ERROR_ID,
        "registered_by": ("", "number of the launch that registered it"),
    },
    "step": {
        "trial_id": _TRIAL_ID,
        "t": ("step", "number of the step, from 0; its time is t · dt"),
        "loss": (
            "unit of the accelerations (m/s², rad/s²)",
            "root-mean-square error of the learned accelerations over the evaluation grid",
        ),
        "reachable_loss": (
            "unit of the accelerations (m/s², rad/s²)",
            "the same over states that the true system visits under strong inputs",
        ),
        "plan_us": ("µs", "time of planning"),
        "learn_us": ("µs", "time of learning"),
        "evaluate_us": ("µs", "time of evaluation"),
    },
    "trajectory": {
        "trial_id": _TRIAL_ID,
        "dtype": ("", "type of the numbers, always 64-bit floating point"),
        "states_shape": ("", "number of states (T + 1) and of their components d, as JSON"),
        "states": ("SI units: m, rad, m/s, rad/s", "states before step 0 to after the last one"),
        "inputs_shape": ("", "number of steps T and of inputs m, as JSON"),
        "inputs": ("unit of the input (N, N m)", "inputs of all steps"),
        "parameters_shape": ("", "number of parameters, as JSON"),
        "parameters": ("", "parameters of the model after the last step"),
    },
    "assessment": {
        "trial_id": _TRIAL_ID,
        "t": ("steps", "explored steps before the assessment"),
        "measure": ("", "name of the measure, such as control_success, coverage or violations"),
        "value": ("of the measure", "value; missing where it is not finite"),
    },
    "launch": {
        "launch_id": ("", "number of the launch in this bundle"),
        "token": ("", "name of the launch that no other one has"),
        "state": ("", "running, done, failed, interrupted or lost"),
        "started": ("UTC", "time of the start"),
        "ended": ("UTC", "time of the end"),
        "lease_until": ("s since 1970", "time until which a launch on PostgreSQL counted as alive"),
        "host": ("", "host of the command"),
        "pid": ("", "process of the command"),
        "argv": ("", "command line as JSON, passwords replaced"),
        "overrides": ("", "settings of the command line as JSON, passwords replaced"),
        "git_commit": ("", "commit of the code"),
        "git_dirty": ("0 or 1", "whether the code differed from the commit"),
        "git_diff_hash": ("", "SHA-256 of the difference from the commit"),
        "versions": ("", "versions of interpreter, libraries and processor, as JSON"),
        "exit_code": ("", "exit code of the command"),
        "fingerprint": ("", "digests of the code, and versions of libraries, as JSON"),
    },
    "attempt": {
        "trial_id": _TRIAL_ID,
        "attempt": ("", "number of the run, from 1"),
        "launch_id": _LAUNCH_ID,
        "outcome": ("", "how the run ended"),
        "cause": ("", "why it failed"),
        "node": ("", "host of the run"),
        "pid": ("", "process of the run"),
        "claimed": ("UTC", "time at which the launch claimed the trial"),
        "started": ("UTC", "time of the start"),
        "ended": ("UTC", "time of the end"),
        **{name: _OUTCOME[name] for name in RUN_COLUMNS if name != "node"},
        "error_id": _ERROR_ID,
    },
    "error": {
        "error_id": ("", "number of the error in this bundle"),
        "hash": ("", "hash of the traceback"),
        "type": ("", "class of the exception"),
        "message": ("", "message of the exception"),
        "traceback": ("", "traceback of the exception"),
    },
}
"""Unit and meaning of the columns of each table, in the order of the schema."""


def write_bundle(
    reader: Reader, configs: Sequence[ConfigRow], wanted: BundleExport
) -> dict[str, Any]:
    """Write the folder, whole or not at all, in place of an earlier bundle; return its provenance.

    It holds all trials of the configurations, whatever their status. ``reader`` sees one moment,
    the one of ``configs``. Raises ``ExportError``.
    """
    if not configs:
        raise ExportError(
            f"{reader.safe_url} holds no trials yet: run a launch that writes to it first."
        )
    with whole_folder(wanted.out, _is_bundle) as folder:
        rows = _write_tables(_Source(reader, configs), folder)
        facts = _facts(reader, configs, wanted, rows)
        (folder / PROVENANCE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
        (folder / VIEWS_FILE).write_text(_views_sql(), encoding="utf-8")
        (folder / CARD).write_text(_card(configs, rows, facts, wanted.license), encoding="utf-8")
        write_checksums(folder)
        return facts | {
            "n_trials": rows["trial"],
            "bytes": sum(path.stat().st_size for path in folder.iterdir()),
        }


def _write_tables(source: _Source, folder: Path) -> dict[str, int]:
    """Return the number of rows of each table."""
    return {
        name: _write_parquet(folder / file_name(name), arrow_schema(name), source.batches(name))
        for name in TABLES
    }


def _facts(
    reader: Reader, configs: Sequence[ConfigRow], wanted: BundleExport, rows: dict[str, int]
) -> dict[str, Any]:
    facts = provenance(reader, configs, wanted.filters)
    missing = "missing in the tables, NaN in the arrays of trajectory: a number that is not finite"
    return {
        "kind": KIND,
        "command": [without_password(word) for word in sys.argv],
        "versions": {
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in _LIBRARIES},
        },
        "license": wanted.license,
        "rows": rows,
        **facts,
        "missing_values": missing,
    }


def _is_bundle(folder: Path) -> bool:
    try:
        facts = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(facts, dict) and facts.get("kind") == KIND


def _views_sql() -> str:
    """Return the statements; files are named relative to the folder of the bundle."""
    tables = [
        f"CREATE OR REPLACE VIEW {name} AS SELECT * FROM read_parquet('{file_name(name)}');\n"
        for name in TABLES
    ]
    views = [f"\nCREATE OR REPLACE VIEW {name} AS{sql.rstrip()};\n" for name, sql in VIEWS.items()]
    return "".join([_HEAD, *tables, *views])


def _write_parquet(path: Path, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> int:
    """Write the rows; return how many."""
    split = [_leaf(field) for field in schema if field.name in (*_SPLIT, *ARRAY_AXES)]
    others = [field.name for field in schema if _leaf(field) not in split]
    rows = 0
    with pyarrow.parquet.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=others,
        column_encoding=dict.fromkeys(split, "BYTE_STREAM_SPLIT") or None,
    ) as writer:
        for table in gathered(batches, _GROUP_BYTES, "nbytes"):
            writer.write_table(table, row_group_size=max(1, table.num_rows))
            rows += table.num_rows
    return rows


def _leaf(field: pa.Field) -> str:
    """Return the path of the numbers of a column within its file."""
    path, kind = str(field.name), field.type
    while pa.types.is_list(kind):
        path, kind = f"{path}.list.element", kind.value_type
    return path


class _Source:
    """Rows that belong to some of the configurations of a database, or to all of them."""

    def __init__(self, reader: Reader, configs: Sequence[ConfigRow]) -> None:
        self._reader = reader
        self._keys = [config.config_key for config in configs]
        self._is_whole = {*self._keys} == {config.config_key for config in reader.configs()}

    def batches(self, table: str) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a table: by configuration, then in the order of its primary key."""
        schema = arrow_schema(table)
        size = ROWS // 100 if table == "trajectory" else ROWS
        for rows in self._rows(table, size):
            columns = dict(zip(schema.names, zip(*rows, strict=True), strict=True))
            arrays = [_array(field, columns) for field in schema]
            yield pa.RecordBatch.from_arrays(arrays, schema=schema)

    def _rows(self, table: str, size: int) -> Iterator[list[Sequence[Any]]]:
        names = ", ".join(f"{table}.{name}" for name in arrow_schema(table).names)
        order = ", ".join(f"{table}.{name}" for name in primary_key(table))
        if table in _REFERENCES:
            where = "1 = 1" if self._is_whole else f"{order} IN ({self._references(table)})"
            sql = f"SELECT {names} FROM {table} WHERE {where} ORDER BY {order}"
            yield from self._reader.batches(size, sql)
            return
        joins = _JOINS[table]
        sql = f"SELECT {names} FROM config {joins} WHERE config.config_key = :key ORDER BY {order}"
        for key in self._keys:
            yield from self._reader.batches(size, sql, key=key)

    def _references(self, table: str) -> str:
        """Return the numbers of the launches or errors that the selected trials refer to."""
        found: set[int] = {-1}
        for name, column in _REFERENCES[table]:
            sql = (
                f"SELECT DISTINCT {name}.{column} FROM config {_JOINS[name]} "
                f"WHERE config.config_key = :key AND {name}.{column} IS NOT NULL"
            )
            for key in self._keys:
                found.update(int(row[0]) for row in self._reader.rows(sql, key=key))
        return ", ".join(map(str, sorted(found)))


def _array(field: pa.Field, columns: dict[str, tuple[Any, ...]]) -> pa.Array:
    values = columns[field.name]
    if field.name in ARRAY_AXES and pa.types.is_list(field.type):
        shapes = columns[f"{field.name}_shape"]
        packed = zip(columns["dtype"], shapes, values, strict=True)
        return _lists([unpack(*one) for one in packed], ARRAY_AXES[field.name])
    if field.name in _TEXTS_OF_USERS:
        return pa.array([*map(_public, values)], field.type)
    return pa.array(values, field.type)


def _public(text: str | None) -> str | None:
    return None if text is None else without_password(text)


def _lists(arrays: Sequence[np.ndarray[Any, Any]], axes: int) -> pa.Array:
    """Return arrays of the same number of axes as nested lists, without touching their numbers."""
    column = pa.array(np.concatenate([array.ravel() for array in arrays]))
    for axis in reversed(range(axes)):
        lengths = [
            np.full(int(np.prod(array.shape[:axis])), array.shape[axis], np.int64)
            for array in arrays
        ]
        ends = np.cumsum(np.concatenate([[0], *lengths]))
        column = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), column)
    return column


def _card(
    configs: Sequence[ConfigRow], rows: Mapping[str, int], facts: Mapping[str, Any], licence: str
) -> str:
    """Return the card.

    Parameters
    ----------
    rows
        Number of rows of each table.
    facts
        Provenance of the bundle: ``program``, ``trials`` by status, ``launches``.
    licence
        Identifier of the licence of the data, "unknown" if nobody has chosen one.
    """
    parts = [
        _header(rows, licence),
        "# Results of dopt: exploration of nonlinear physical systems\n",
        _summary(configs, facts, licence),
        "## Load\n",
        _LOADING,
        "## Tables\n",
        "A number that is not finite is missing, but within the lists of `trajectory` it is NaN; "
        "`diverged_at` gives the reason.\n",
        *(_table(name, title, rows[name]) for name, title in TABLE_TITLES.items()),
        "## Origin\n",
        _origin(facts),
        "## Citation\n",
        _CITATION,
    ]
    return "\n".join(parts)


def _header(rows: Mapping[str, int], licence: str) -> str:
    size = next((name for most, name in _SIZES if rows["step"] < most), "n>10M")
    lines = [
        "---",
        f"license: {licence}",
        "pretty_name: Results of dopt",
        "tags: [system-identification, active-learning, optimal-experiment-design, physics]",
        f"size_categories: ['{size}']",
        "configs:",
    ]
    for name in TABLE_TITLES:
        lines += [f"  - config_name: {name}", f"    data_files: {file_name(name)}"]
    return "\n".join([*lines, "---", ""])


def _summary(configs: Sequence[ConfigRow], facts: Mapping[str, Any], licence: str) -> str:
    counts = Counter({name: int(n) for name, n in facts["trials"].items() if name != "n" and n})
    listed = ", ".join(f"{n:,} {status}" for status, n in counts.items())
    systems = ", ".join(sorted({config.env for config in configs}))
    policies = ", ".join(sorted({config.policy for config in configs}))
    stated = f"`{licence}`" if licence != "unknown" else "not stated; ask those who gave it to you"
    return (
        f"{counts.total():,} trials ({listed}) of {len(configs):,} configurations. In each trial a "
        "model learns the unmodelled accelerations of a simulated system online, while a policy "
        "chooses the inputs.\n\n"
        f"- systems: {systems}\n- policies: {policies}\n"
        f"- licence of the data: {stated}\n"
    )


def _table(name: str, title: str, rows: int) -> str:
    lines = [
        f"### `{file_name(name)}`\n",
        f"{rows:,} rows; {title}.\n",
        "| column | unit | meaning |",
        "|---|---|---|",
    ]
    lines += [f"| `{one}` | {unit} | {text} |" for one, (unit, text) in COLUMNS[name].items()]
    return "\n".join([*lines, ""])


def _origin(facts: Mapping[str, Any]) -> str:
    commits = sorted({_commit(launch) for launch in facts["launches"]})
    return (
        f"Written by {facts['program']}; the code that ran the trials: {', '.join(commits)}. "
        "`provenance.json` has the commands, the versions of the libraries, the filters and the "
        "configurations.\n"
    )


def _commit(launch: Mapping[str, Any]) -> str:
    commit = launch["git_commit"]
    if commit is None:
        return "commit unknown"
    return f"commit {commit[:12]}{' with changes' if launch['git_dirty'] else ''}"
