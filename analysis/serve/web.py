"""Requests, answers and state: query parameters, errors, pages, database, caches, events."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Hashable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from decimal import Decimal
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response, StreamingResponse

from analysis.data.matching import AnalysisError, Filter, read_condition
from analysis.data.selection import Selection, select
from analysis.style import environment_title, number, plus_minus
from dopt.errors import DoptError, suggestion
from orchestrate.store import Reader
from orchestrate.store.backend import parse_url, public_url, read_login, sqlite_path
from orchestrate.store.records import jsonable
from orchestrate.store.sqlite import identity

E = TypeVar("E", bound=StrEnum)

FOLDER = Path(__file__).parent

LARGEST = 2**31 - 1
"""Largest integer; both databases accept it for every integer column."""


class RequestError(AnalysisError):
    """A request that is not answered, with its HTTP status: 400 for an invalid parameter."""

    def __init__(self, sentence: str, status: int = 400) -> None:
        super().__init__(sentence)
        self.status = status


class QueryParams:
    """Query parameters by name; an empty value counts as not given, an invalid one is an error."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str, default: str = "") -> str:
        """Return a text; zero characters are refused because no database accepts them."""
        value = self._values.get(name, "").strip()
        if "\0" in value:
            raise RequestError(
                f"'{name}' holds a zero character, a text is expected: remove that character."
            )
        return value or default

    def choice(self, name: str, choices: Iterable[str], default: str = "") -> str:
        """Return one of several texts."""
        value, known = self.text(name, default), list(choices)
        if value and value not in known:
            hint = suggestion(value, known) if known else "remove it, none exists."
            raise RequestError(f"'{name}' is '{truncated(value)}', which is not valid: {hint}")
        return value

    def member(self, name: str, kind: type[E], default: E) -> E:
        """Return a member of an enumeration."""
        return kind(self.choice(name, list(kind), default))

    def integer(self, name: str, low: int = 0, high: int = LARGEST) -> int | None:
        """Return an integer within bounds, None if it is not given."""
        value = self.text(name)
        if not value:
            return None
        digits = value.removeprefix("-")
        if digits.isascii() and digits.isdigit() and len(digits) < 20 and low <= int(value) <= high:
            return int(value)
        raise RequestError(
            f"'{name}' is '{truncated(value)}', expected is a whole number of {low} to {high}: "
            f"write one."
        )

    def filter(self, environment: str) -> Filter:
        """Return the filter of an environment's configurations with ``where`` and ``width``."""
        conditions = dict(map(read_condition, self.text("where").split()))
        width = self.integer("width", low=1)
        if width is not None:
            conditions["model.width"] = width
        return Filter((environment,), (), conditions)


def truncated(text: str, length: int = 60) -> str:
    """Return the start of a text with unprintable characters replaced."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"


def as_json(content: Mapping[str, Any], status: int = 200) -> Response:
    """Return a JSON response."""
    text = json.dumps(jsonable(content), allow_nan=False, separators=(",", ":"))
    return Response(text, status, media_type="application/json")


def as_csv(text: str, name: str) -> Response:
    """Return a CSV response that the browser saves as a file."""
    headers = {"content-disposition": f'attachment; filename="{name}.csv"'}
    return Response(text, media_type="text/csv", headers=headers)


def as_page(template: str, content: Mapping[str, Any], status: int = 200) -> Response:
    """Return an HTML page."""
    return HTMLResponse(_pages.get_template(template).render(content), status)


def numeral(value: Any, digits: int = 4) -> str:
    """Return a number with few digits, a dash for None, other values as text."""
    if value is None:
        return "–"
    if isinstance(value, bool | int):
        return str(value)
    return number(float(value), digits) if isinstance(value, float | Decimal) else str(value)


def moment(value: str | None) -> str:
    """Return a stored time without its fraction of a second."""
    try:
        return datetime.fromisoformat(str(value)).strftime("%Y-%m-%d %H:%M:%S UTC")
    except ValueError:
        return "–"


def duration(seconds: float | None) -> str:
    """Return a duration in ms, s, min or h."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


_pages = Environment(
    loader=FileSystemLoader(FOLDER / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_pages.filters.update(
    numeral=numeral,
    loss=plus_minus,
    moment=moment,
    duration=duration,
    mebibytes=lambda count: "–" if count is None else f"{count / 2**20:.0f} MiB",
    title=environment_title,
    exact=lambda value: f"{value:.10g}",
)


PERIOD = 1.0
"""Least time between two readings of the progress [s]; a reading may take a tenth of it."""

SILENCE = 15.0
"""Time after which an unchanged stream sends a comment [s], so that nobody takes it for dead."""

COMMENT = ": nothing new\n\n"
MEDIA_TYPE = "text/event-stream"

_TRIALS = """
SELECT status, count(*) AS n, sum(attempt) AS attempts, sum(coalesce(n_steps, 0)) AS steps
FROM trial GROUP BY status ORDER BY status
"""
_LAUNCHES = """
SELECT count(*) AS n, max(launch_id) AS newest, count(*) FILTER (WHERE state = 'running') AS running
FROM launch
"""

T = TypeVar("T")
Identity = tuple[int, int] | None


class Database:
    """Access to the database at a URL, which may be missing, created later or replaced."""

    def __init__(self, url: str) -> None:
        parsed = parse_url(url)
        self.safe_url = public_url(parsed)
        self._url = url
        self.user = parsed.username
        self.read_login = read_login(parsed)
        self.is_file = parsed.get_backend_name() == "sqlite"
        self._path = sqlite_path(parsed) if self.is_file else None
        self._lock = threading.Lock()
        self._reader: Reader | None = None
        self._identity: Identity = None

    def reader(self) -> Reader:
        """Return a reader; raise ``StoreError`` for a missing database or another schema."""
        with self._lock:
            identity = self._file()
            if self._reader is None or identity != self._identity:
                self.close()
                self._reader = Reader.open(self._url)
                self._identity = identity
            return self._reader

    def close(self) -> None:
        """Close the connections."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _file(self) -> Identity:
        """Return device and inode of the database file; None without one or on PostgreSQL."""
        if self._path is None:
            return None
        found = identity(self._path)
        if found is None:
            self.close()
        return found


class Cache:
    """Thread-safe cache that drops the least recently used entry beyond ``size`` entries.

    A key contains everything that its value depends on, such as the finished trials of a
    configuration, so a cached value is never stale. Two threads may compute one value concurrently.
    """

    def __init__(self, size: int = 1024) -> None:
        self._size = size
        self._lock = threading.Lock()
        self._values: OrderedDict[Hashable, object] = OrderedDict()

    def get_or_compute(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return the value of a key; compute it when it is not cached."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return cast("T", self._values[key])
        value = compute()
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._size:
                self._values.popitem(last=False)
        return value


def read_progress(reader: Reader) -> dict[str, Any]:
    """Return the counts of trials by status, and a token that changes when a trial changes."""
    trials = [[row.status, *map(int, row[1:])] for row in reader.rows(_TRIALS)]
    (launches,) = reader.rows(_LAUNCHES)
    counts = {status: n for status, n, *_ in trials}
    content = json.dumps([trials, list(launches)])
    return {
        "token": hashlib.sha256(content.encode()).hexdigest()[:16],
        "counts": counts,
        "total": sum(counts.values()),
        "ended": sum(n for status, n in counts.items() if status not in ("pending", "running")),
        "launches_running": int(launches.running),
    }


class Events:
    """Progress of the database, read once a second for all streams together while one is open."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self._latest = ""
        self._due = 0.0
        self._reading = asyncio.Lock()
        self._end = asyncio.Event()

    def end(self) -> None:
        """End all streams, now and later."""
        self._end.set()

    @property
    def ended(self) -> bool:
        return self._end.is_set()

    async def respond(self, request: Request) -> Response:
        """Return the stream."""
        if request.method == "HEAD":
            return Response(media_type=MEDIA_TYPE)
        return StreamingResponse(self.stream(), media_type=MEDIA_TYPE)

    async def stream(self) -> AsyncIterator[str]:
        """Yield the progress, and again after every change, until the server ends."""
        sent, said = "", 0.0
        while not self.ended:
            latest, now = await self._read(), time.monotonic()
            if latest != sent or now - said >= SILENCE:
                yield COMMENT if latest == sent else latest
                sent, said = latest, now
            with suppress(TimeoutError):
                wait = min(self._due - time.monotonic(), SILENCE)
                await asyncio.wait_for(self._end.wait(), max(wait, 0.0))

    async def _read(self) -> str:
        """Return the newest event; the first stream that asks after a while reads it for all."""
        async with self._reading:
            start = time.monotonic()
            if start >= self._due:
                self._latest = await asyncio.to_thread(self._event)
                now = time.monotonic()
                self._due = now + max(PERIOD, 10 * (now - start))
            return self._latest

    def _event(self) -> str:
        """Return the event ``progress``, or ``unavailable`` for a database that has none."""
        try:
            name, content = "progress", read_progress(self.database.reader())
        except DoptError as error:
            name, content = "unavailable", {"error": str(error)}
        return f"event: {name}\ndata: {json.dumps(content)}\n\n"


@dataclass(frozen=True)
class ServerState:
    """The database with its event stream, and caches of computed values.

    ``exposed``: other machines reach the server. ``token``: secret of this process's forms.
    """

    database: Database
    exposed: bool = False
    token: str = field(default_factory=secrets.token_urlsafe)
    cache: Cache = field(default_factory=Cache)
    selections: Cache = field(default_factory=lambda: Cache(6))  # each contains all its trials

    @cached_property
    def events(self) -> Events:
        """The event stream of the database."""
        return Events(self.database)

    def select(self, reader: Reader, wanted: Filter) -> Selection:
        """Return the requested trials; they are read again after any trial changed."""
        key = ("selection", reader, read_progress(reader)["token"], repr(wanted))
        return self.selections.get_or_compute(key, lambda: select(reader, wanted))
