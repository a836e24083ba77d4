"""Event stream: the progress of the database, sent to all open pages when it changes."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from analysis.serve.database import Database
from analysis.serve.progress import read_progress
from dopt.errors import DoptError

PERIOD = 1.0
"""Least time between two readings [s]; a reading may take a tenth of it."""

SILENCE = 15.0
"""Time after which an unchanged stream sends a comment [s], so that nobody takes it for dead."""

COMMENT = ": nothing new\n\n"
MEDIA_TYPE = "text/event-stream"


@dataclass
class Events:
    """Progress of one database, read once a second for all streams together while one is open."""

    database: Database
    _latest: str = ""
    _n_open: int = 0
    ended: bool = False
    _reading: asyncio.Task[None] | None = None
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    async def stream(self) -> AsyncIterator[str]:
        """Yield the progress, and again after every change, until the server ends."""
        self._open()
        try:
            sent = ""
            while not self.ended:
                if self._latest == sent and not await self._change():
                    yield COMMENT
                elif self._latest != sent:
                    sent = self._latest
                    yield sent
        finally:
            self._close()

    def end(self) -> None:
        """End all streams, now and later."""
        self.ended = True
        self._tell()

    def _open(self) -> None:
        self._n_open += 1
        if self._reading is None:
            self._reading = asyncio.create_task(self._read())

    def _close(self) -> None:
        self._n_open -= 1
        if not self._n_open and self._reading:
            self._reading.cancel()
            self._reading, self._latest = None, ""

    async def _change(self) -> bool:
        """Wait for the next change; return whether it came. Raises what the reading raised."""
        assert self._reading
        change = asyncio.ensure_future(self._changed.wait())
        done, _ = await asyncio.wait(
            [change, self._reading], timeout=SILENCE, return_when=asyncio.FIRST_COMPLETED
        )
        change.cancel()
        if self._reading in done:
            await self._reading
        return bool(done)

    async def _read(self) -> None:
        while True:
            start = time.monotonic()
            latest = await asyncio.to_thread(_event, self.database)
            if latest != self._latest:
                self._latest = latest
                self._tell()
            await asyncio.sleep(max(PERIOD, 10 * (time.monotonic() - start)))

    def _tell(self) -> None:
        """Wake all streams."""
        self._changed.set()
        self._changed = asyncio.Event()


def respond(events: Events, request: Request) -> Response:
    """Return the stream."""
    if request.method == "HEAD":
        return Response(media_type=MEDIA_TYPE)
    return StreamingResponse(events.stream(), media_type=MEDIA_TYPE)


def _event(database: Database) -> str:
    """Return the event ``progress``, or ``unavailable`` for a database that cannot be read."""
    try:
        return _text("progress", read_progress(database.reader()))
    except DoptError as error:
        return _text("unavailable", {"error": str(error)})


def _text(name: str, content: dict[str, Any]) -> str:
    return f"event: {name}\ndata: {json.dumps(content)}\n\n"
