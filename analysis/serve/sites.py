"""Several databases on one server: the first has the paths ``/...``, others ``/db/NAME/...``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePath

from analysis.serve.database import Database
from analysis.serve.state import Link, ServerState
from orchestrate.store.database_url import parse


def states_of(urls: Sequence[str], figures: Path, exposed: bool = False) -> list[ServerState]:
    """Return the state of each database; raise ``StoreError`` for an invalid URL.

    ``exposed`` says whether other machines reach the server.
    """
    names = _names(urls)
    bases = ["", *(f"/db/{name}" for name in names[1:])]
    links = tuple(map(Link, names, bases))
    return [
        ServerState(Database(url), figures, link, links, exposed)
        for url, link in zip(urls, links, strict=True)
    ]


def state_at(states: Sequence[ServerState], path: str) -> ServerState:
    """Return the state of the database to which a path belongs."""
    return next((one for one in states[1:] if path.startswith(f"{one.base}/")), states[0])


def _names(urls: Sequence[str]) -> list[str]:
    """Return the name of each file or database, with a number where it is taken."""
    names: list[str] = []
    for url in urls:
        stem = PurePath(parse(url).database or "").stem
        name = plain = re.sub(r"[^A-Za-z0-9_-]+", "-", stem).strip("-") or "database"
        while name in names:
            name = f"{plain}-{len(names) + 1}"
        names.append(name)
    return names
