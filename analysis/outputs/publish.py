"""Writing of the files of an output: atomically, and only if the content has changed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from orchestrate.files import whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = ("pdf", "svg", "png")


def fingerprint(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of everything that an output depends on."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def is_current(folder: Path, name: str, endings: tuple[str, ...], mark: str) -> bool:
    """Whether all files of an output exist and were made from the same content."""
    if not all((folder / f"{name}.{ending}").is_file() for ending in (*endings, "json")):
        return False
    try:
        found = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except ValueError:
        return False
    return bool(isinstance(found, dict) and found.get("fingerprint") == mark)


def write_pictures(figure: Figure, folder: Path, name: str, title: str, mark: str) -> None:
    """Write a figure in every format, with its title and fingerprint, in the context of the style.

    The layout is computed once, so that all formats show the same picture and none is drawn twice.
    """
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine(None)
    for ending in PICTURES:
        with whole(folder / f"{name}.{ending}") as part:
            figure.savefig(part, format=ending, metadata=_metadata(ending, title, mark))


def _metadata(ending: str, title: str, mark: str) -> dict[str, Any]:
    """Return metadata without a clock; with SOURCE_DATE_EPOCH set, matplotlib writes that date."""
    about = f"fingerprint {mark}, see the JSON file beside this one"
    undated = "SOURCE_DATE_EPOCH" not in os.environ
    if ending == "pdf":
        return {"Title": title, "Subject": about} | ({"CreationDate": None} if undated else {})
    if ending == "svg":
        return {"Title": title, "Description": about} | ({"Date": None} if undated else {})
    return {"Title": title, "Description": about}


def write_table(table: pd.DataFrame, folder: Path, name: str) -> None:
    """Write the CSV of a table; NaN is an empty field, numbers have all their digits."""
    write_text(table.to_csv(index=False, lineterminator="\n"), folder / f"{name}.csv")


def write_provenance(content: Mapping[str, Any], folder: Path, name: str) -> None:
    """Write the JSON beside an output; the last of its files, so that it vouches for the others."""
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False)
    write_text(text + "\n", folder / f"{name}.json")


def write_text(text: str, target: Path) -> None:
    """Write a file whole or not at all."""
    with whole(target) as part:
        part.write_text(text, encoding="utf-8")
