"""``README.md`` of the folder of figures: all pictures and tables on one page, with captions."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from analysis.outputs import publish

NAME = "README.md"


def write_page(folder: Path, pictures: Iterable[str], tables: Iterable[str]) -> bool:
    """Write the page of those outputs that the folder holds; False if it was the same already."""
    sections = [_table(folder, name) for name in tables] + [_picture(folder, n) for n in pictures]
    found = [section for section in sections if section]
    if not found:
        return False
    text = "\n\n".join(["# Figures and tables", _origin(folder), *found]) + "\n"
    target = folder / NAME
    if target.is_file() and target.read_text(encoding="utf-8") == text:
        return False
    publish.write_text(text, target)
    return True


def _picture(folder: Path, name: str) -> str | None:
    facts = _facts(folder, name)
    if not facts or not (folder / f"{name}.png").is_file():
        return None
    caption = facts["caption"]
    return (
        f"## {facts['title']}\n\n![{facts['title']}]({name}.png)\n\n{caption}\n\n"
        f"{_links(name, ('pdf', 'svg', 'csv', 'json'))}"
    )


def _table(folder: Path, name: str) -> str | None:
    facts, path = _facts(folder, name), folder / f"{name}.md"
    if not facts or not path.is_file():
        return None
    text = path.read_text(encoding="utf-8").rstrip()
    return f"## {facts['title']}\n\n{text}\n\n{_links(name, ('csv', 'tex', 'json'))}"


def _links(name: str, endings: tuple[str, ...]) -> str:
    return " · ".join(f"[{name}.{ending}]({name}.{ending})" for ending in endings)


def _origin(folder: Path) -> str:
    """Return a sentence on the databases and the code that the outputs come from."""
    all_facts = [_facts(folder, path.stem) for path in sorted(folder.glob("*.json"))]
    known = [facts for facts in all_facts if facts]
    databases = sorted({str(facts["database"]) for facts in known})
    versions = sorted({str(facts["versions"]["dopt"]) for facts in known})
    return (
        f"Made by dopt {', '.join(versions)} from {', '.join(f'`{url}`' for url in databases)}. "
        f"Each output has its numbers as CSV and its provenance as JSON beside it."
    )


def _facts(folder: Path, name: str) -> Mapping[str, Any] | None:
    """Return what an output says of itself, None where it is not there or not whole."""
    try:
        found = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    wanted = {"title", "caption", "database", "versions"}
    return found if isinstance(found, dict) and wanted <= found.keys() else None
