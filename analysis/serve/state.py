"""State that all pages share: database, folder of figures and caches."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from analysis.data.config_matching import Filter
from analysis.data.trial_selection import Selection, select
from analysis.serve.cache import Cache
from analysis.serve.database import Database
from analysis.serve.events import Events
from analysis.serve.progress import read_progress
from orchestrate.store import Reader


@dataclass(frozen=True)
class Link:
    """Name of a database on its pages, and the start of their paths."""

    name: str
    base: str


@dataclass(frozen=True)
class ServerState:
    """A database with its event stream, the folder of figures, and caches of computed values.

    Attributes
    ----------
    link
        Where the pages of the database are.
    links
        Where those of all databases of the server are, this one included.
    exposed
        Whether other machines reach the server.
    token
        Secret of the forms of this process, which no page of another site knows.
    """

    database: Database
    figures: Path
    link: Link
    links: tuple[Link, ...]
    exposed: bool = False
    token: str = field(default_factory=secrets.token_urlsafe)
    cache: Cache = field(default_factory=Cache)
    selections: Cache = field(default_factory=lambda: Cache(6))  # each contains all its trials

    @property
    def name(self) -> str:
        return self.link.name

    @property
    def base(self) -> str:
        return self.link.base

    @cached_property
    def events(self) -> Events:
        """The event stream of the database."""
        return Events(self.database)

    def select(self, reader: Reader, wanted: Filter) -> Selection:
        """Return the requested trials; they are read again after any trial changed."""
        key = ("selection", reader, read_progress(reader)["token"], repr(wanted))
        return self.selections.get_or_compute(key, lambda: select(reader, wanted))
