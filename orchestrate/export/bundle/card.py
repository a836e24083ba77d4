"""File ``README.md`` of a bundle: a dataset card with the header that Hugging Face reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from orchestrate.export.bundle.descriptions import COLUMNS, TABLE_TITLES
from orchestrate.store import ConfigRow
from orchestrate.store.bundle import file_name

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


def card(
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
