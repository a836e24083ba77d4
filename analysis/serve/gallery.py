"""Figures page: pictures, captions, tables and provenance from the folder of figures.

A file is served only if the folder's listing contains its name, so no URL can leave the folder.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from analysis.serve.errors import NotFoundError
from analysis.serve.query_params import QueryParams, truncated
from analysis.serve.state import ServerState

PICTURES = ("svg", "png", "gif")
FILMS = ("mp4", "webm")
TYPES = {
    "csv": "text/csv; charset=utf-8",
    "gif": "image/gif",
    "json": "application/json",
    "md": "text/plain; charset=utf-8",
    "mp4": "video/mp4",
    "pdf": "application/pdf",
    "png": "image/png",
    "svg": "image/svg+xml",
    "tex": "text/plain; charset=utf-8",
    "txt": "text/plain; charset=utf-8",
    "webm": "video/webm",
}
LONGEST_TABLE = 60
FACTS = ("statistic", "band", "database", "schema", "selection", "fingerprint", "git", "versions")


def gallery(state: ServerState, params: QueryParams) -> dict[str, Any]:  # noqa: ARG001  # the signature is that of every page
    """Return the content of the folder, one item per file stem, figures before tables."""
    groups: dict[str, dict[str, Path]] = {}
    for path in files(state.figures).values():
        groups.setdefault(path.stem, {})[path.suffix[1:]] = path
    items = [_item(name, paths) for name, paths in sorted(groups.items()) if name != "README"]
    shown = [item for item in items if item["picture"] or item["film"] or item["table"]]
    shown.sort(key=lambda item: (not (item["picture"] or item["film"]), item["name"]))
    return {"folder": state.figures.name, "exists": state.figures.is_dir(), "items": shown}


def files(folder: Path) -> dict[str, Path]:
    """Return the files that may be served, by name: regular files of known types, no links."""
    if not folder.is_dir():
        return {}
    return {
        path.name: path
        for path in sorted(folder.iterdir())
        if path.suffix[1:] in TYPES
        and not path.name.startswith(".")
        and path.is_file()
        and not path.is_symlink()
    }


def find(state: ServerState, name: str) -> Path:
    """Return a file of the folder; raise ``NotFoundError`` for any other name."""
    found = files(state.figures).get(name)
    if found is None:
        raise NotFoundError(
            f"There is no figure file '{truncated(name)}': choose one of the figures page."
        )
    return found


def _item(name: str, paths: dict[str, Path]) -> dict[str, Any]:
    facts = _facts(paths.get("json"))
    picture = next((paths[kind].name for kind in PICTURES if kind in paths), None)
    film = next((paths[kind].name for kind in FILMS if kind in paths), None)
    return {
        "name": name,
        "title": facts.get("title", name.replace("_", " ")),
        "picture": picture,
        "film": film,
        "caption": _text(paths.get("txt")) or str(facts.get("caption", "")),
        "table": None if picture or film else _rows(paths.get("csv")),
        "facts": {key: facts[key] for key in FACTS if key in facts},
        "files": [
            {"kind": kind, "name": path.name, "bytes": path.stat().st_size}
            for kind, path in sorted(paths.items())
        ],
    }


def _facts(path: Path | None) -> dict[str, Any]:
    try:
        found = json.loads(_text(path) or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _text(path: Path | None) -> str:
    """Return a file's text; empty while the file is being rewritten."""
    try:
        return path.read_text(encoding="utf-8").strip() if path else ""
    except (OSError, ValueError):
        return ""


def _rows(path: Path | None) -> list[list[str]] | None:
    """Return the first rows of a CSV file; None without one."""
    text = _text(path)
    return list(csv.reader(text.splitlines()[: LONGEST_TABLE + 1])) if text else None
