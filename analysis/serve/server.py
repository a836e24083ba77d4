"""Web server of the results browser, which bounds its connections and always ends."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Callable

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from analysis.serve.app import end_streams

REQUEST_SECONDS = 10.0
"""Time in which the head of a request has to arrive."""

MAX_WAITING = 64
"""Connections without a whole request; beyond it the oldest is closed."""

MAX_CONNECTIONS = 128
"""Connections and requests; beyond it the answer is 503."""

LOG_SECONDS = 60.0
_next: dict[tuple[str, int], float] = {}
"""When the next warning of a place in the code is logged."""

END_SECONDS = 5.0
"""Time in which open requests end after Ctrl-C."""


class Connection(H11Protocol):
    """HTTP connection that is closed when its next request does not come whole and in time."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._watch()
        waiting = {one: one._late for one in self.connections if isinstance(one, Connection)}
        late = sorted((timer.when(), id(one), one) for one, timer in waiting.items() if timer)
        for _, _, one in late[:-MAX_WAITING]:
            one._close()

    def data_received(self, data: bytes) -> None:
        """Take a part of a request."""
        super().data_received(data)
        self._watch()

    def _watch(self) -> None:
        if not getattr(self.cycle, "response_complete", True):
            if self._late:
                self._late.cancel()
            self._late = None
        elif self._late is None:  # not again with each part: a slow client sends one at a time
            self._late = self.loop.call_later(REQUEST_SECONDS, self._close)

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.logger.warning("Connections that sent no whole request were closed.")
            self.transport.abort()


def seldom(record: logging.LogRecord) -> bool:
    """Let a warning of each kind pass once a minute: strangers decide how often it is logged."""
    place, now = (record.pathname, record.lineno), time.monotonic()
    if record.levelno <= logging.WARNING and now < _next.get(place, now):
        return False
    _next[place] = now + LOG_SECONDS
    return True


class Server(uvicorn.Server):
    """Server that ends event streams and statements before it waits for connections to close.

    ``leave`` is called where a request is still computed long after the end was asked for.
    """

    def __init__(
        self, app: Starlette, port: int = 8000, leave: Callable[[], object] = lambda: None
    ) -> None:
        config = uvicorn.Config(
            app,
            port=port,
            log_level="warning",
            server_header=False,
            lifespan="on",
            http=Connection,
            ws="none",
            limit_concurrency=MAX_CONNECTIONS,
        )
        super().__init__(config)
        logging.getLogger("uvicorn.error").addFilter(seldom)
        self._app = app
        self._leave = leave
        self._others = set(threading.enumerate())

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what is open."""
        end_streams(self._app)
        last = threading.Timer(END_SECONDS, self._leave_requests)
        last.daemon = True
        last.start()
        await super().shutdown(sockets)

    def _leave_requests(self) -> None:
        busy = self.server_state.connections or self.server_state.tasks
        if busy or any(not one.daemon for one in {*threading.enumerate()} - self._others):
            self._leave()
