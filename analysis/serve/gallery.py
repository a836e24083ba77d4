"""The folder of figures as a page: pictures with their captions, tables, and where they are from.

A file is served only if its plain name is in the listing of the folder, so that no address leads
out of it.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from analysis.serve.asked import Asked, short
from analysis.serve.errors import NotFoundError
from analysis.serve.site import Site

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


def gallery(site: Site, asked: Asked) -> dict[str, Any]:  # noqa: ARG001  # the signature is that of every page
    """Return what lies in the folder, one item for each name, figures before tables."""
    groups: dict[str, dict[str, Path]] = {}
    for path in files(site.figures).values():
        groups.setdefault(path.stem, {})[path.suffix[1:]] = path
    items = [_item(name, paths) for name, paths in sorted(groups.items()) if name != "README"]
    shown = [item for item in items if item["picture"] or item["film"] or item["table"]]
    shown.sort(key=lambda item: (not (item["picture"] or item["film"]), item["name"]))
    return {"folder": site.figures.name, "exists": site.figures.is_dir(), "items": shown}


def files(folder: Path) -> dict[str, Path]:
    """Return the files that may be served, by name: plain ones of known types, no links."""
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


def find(site: Site, name: str) -> Path:
    """Return a file of the folder; raise ``NotFoundError`` for any other name."""
    found = files(site.figures).get(name)
    if found is None:
        raise NotFoundError(f"There is no figure file '{short(name)}': see the page of figures.")
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
    """Return a file's text; none where a figure is just being written anew."""
    try:
        return path.read_text(encoding="utf-8").strip() if path else ""
    except (OSError, ValueError):
        return ""


def _rows(path: Path | None) -> list[list[str]] | None:
    """Return the first rows of a CSV; None where there is none."""
    text = _text(path)
    return list(csv.reader(text.splitlines()[: LONGEST_TABLE + 1])) if text else None
