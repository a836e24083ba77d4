"""Routes and server of the results browser: checks of each request, bounds on connections.

A foreign web site may point a DNS name at 127.0.0.1 (DNS rebinding) or embed URLs of this server.
The Host header reveals the first, Sec-Fetch-Site the second; the response headers keep pages from
running or loading foreign content. Statements of the SQL page come by POST, from a form of this
server alone; a link shows a page and runs nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import socket
import threading
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Any
from urllib.parse import parse_qsl

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from analysis.serve import is_loopback, pages, sql
from analysis.serve.web import (
    FOLDER,
    Database,
    QueryParams,
    RequestError,
    ServerState,
    as_csv,
    as_json,
    as_page,
)
from dopt.errors import DoptError
from orchestrate.store import NoDatabaseError, SchemaVersionError, StoreUnavailableError

Numbers = Callable[[ServerState, QueryParams], Mapping[str, Any]]
Answer = Callable[[ServerState, Request, QueryParams, sql.Stopped], Response]

FORM_SECONDS = 10.0
"""Time in which a form has to arrive."""

PAGES: tuple[tuple[str, str, Numbers], ...] = (
    ("/", "grid", pages.grid),
    ("/curves", "curves", pages.choices),
    ("/trials", "trials", pages.trials),
    ("/trials/{trial_key}", "trial", pages.trial),
    ("/sql", "sql", sql.form),
)
DATA: tuple[tuple[str, Numbers], ...] = (
    ("/api/grid", pages.grid),
    ("/api/curves", pages.curves),
    ("/api/trials", pages.trials),
    ("/api/trials/{trial_key}", pages.trial),
    ("/api/trials/{trial_key}/arrays", pages.arrays),
)
UNAVAILABLE = (NoDatabaseError, SchemaVersionError, StoreUnavailableError)
"""Errors of a database that may be there later."""


def create_app(url: str, host: str = "127.0.0.1") -> Starlette:
    """Return the application for a database; ``host`` is the address that the server listens at.

    Raises ``StoreError`` for an invalid database URL. A database that does not exist yet gives an
    error page until it is created.
    """
    state = ServerState(Database(url), not is_loopback(host))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        state.database.close()

    app = Starlette(
        routes=[
            Mount("/static", StaticFiles(directory=FOLDER / "static")),
            *(Route(path, partial(_page, state, name, numbers)) for path, name, numbers in PAGES),
            *(Route(path, partial(_data, state, numbers)) for path, numbers in DATA),
            *(Route(path, partial(_ask, state, to), methods=["POST"]) for path, to in STATEMENTS),
            Route("/api/curves.csv", partial(_curves_table, state)),
            Route("/api/events", state.events.respond),
        ],
        middleware=[Middleware(SecurityMiddleware, host=host)],
        exception_handlers={
            DoptError: partial(_error_response, state),
            HTTPException: partial(_error_response, state),
            Exception: partial(_server_error, state),
        },
        lifespan=lifespan,
    )
    app.state.end = state.events.end
    return app


def _query_params(request: Request) -> QueryParams:
    return QueryParams({**dict(request.query_params), **request.path_params})


def _page(state: ServerState, name: str, numbers: Numbers, request: Request) -> Response:
    content = numbers(state, _query_params(request))
    query = defaultdict(str, {k: v for k, v in request.query_params.items() if v})
    frame = {"page": name, "database": state.database.safe_url, "query": query}
    return as_page(f"{name}.html", frame | dict(content), 400 if content.get("error") else 200)


def _data(state: ServerState, numbers: Numbers, request: Request) -> Response:
    content = numbers(state, _query_params(request))
    return as_json(content, 400 if content.get("error") else 200)


async def _ask(state: ServerState, answer: Answer, request: Request) -> Response:
    """Run the statement of a form until it ends, its client leaves, or the server ends."""
    params = await _form(request)
    left = threading.Event()

    def stopped() -> bool:
        return left.is_set() or state.events.ended

    work = asyncio.create_task(run_in_threadpool(answer, state, request, params, stopped))
    leaving = asyncio.create_task(_leaving(request))
    try:
        await asyncio.wait((work, leaving), return_when=asyncio.FIRST_COMPLETED)
    finally:
        left.set()
        leaving.cancel()
    return await work


async def _form(request: Request) -> QueryParams:
    body = b""
    try:
        async with asyncio.timeout(FORM_SECONDS):
            async for part in request.stream():
                body += part
                if len(body) > LONGEST_QUERY:
                    raise RequestError(f"The form is too long, at most {LONGEST_QUERY} bytes.")
    except (TimeoutError, ClientDisconnect) as error:
        raise RequestError("The form did not arrive whole and in time: send it again.") from error
    return QueryParams(dict(parse_qsl(body.decode("latin-1"))))


async def _leaving(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


STATEMENTS: tuple[tuple[str, Answer], ...] = (
    ("/sql", lambda state, at, *ask: _page(state, "sql", lambda *_: sql.rows(state, *ask), at)),
    ("/api/sql", lambda state, at, *ask: _data(state, lambda *_: sql.rows(state, *ask), at)),
    ("/api/sql.csv", lambda state, _, *ask: as_csv(sql.table(state, *ask), "sql")),
)


def _curves_table(state: ServerState, request: Request) -> Response:
    return as_csv(pages.curves_table(state, _query_params(request)), "curves")


def _error_response(state: ServerState, request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        status = getattr(error, "status", 503 if isinstance(error, UNAVAILABLE) else 400)
        return _message(state, request, status, str(error).replace("--where", "the field Where"))
    missing = "This page does not exist: choose a page from the menu above."
    sentence = missing if error.status_code == 404 else f"{error.detail}."
    return _message(state, request, error.status_code, sentence)


def _server_error(state: ServerState, request: Request, error: Exception) -> Response:
    logging.getLogger(__name__).error("%r failed", request.scope["path"], exc_info=error)
    return _message(
        state, request, 500, "This page failed: the server's terminal shows the traceback."
    )


def _message(state: ServerState, request: Request, status: int, sentence: str) -> Response:
    path = request.scope["path"]
    if path.startswith("/api/"):
        return as_json({"error": sentence}, status)
    content = {"page": path.split("/")[1] or "grid", "database": state.database.safe_url}
    return as_page("message.html", content | {"sentence": sentence, "status": status}, status)


METHODS = ("GET", "HEAD")
_STATEMENTS = re.compile(r"/sql|/api/sql(\.csv)?")
LONGEST_QUERY = 16_000
"""Bytes of a query string; a long SQL statement has a few thousand."""

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}

REQUEST_SECONDS = 10.0
"""Time in which the head of a request has to arrive."""

MAX_WAITING = 64
"""Connections without a whole request; beyond it the oldest is closed."""

MAX_CONNECTIONS = 128
"""Connections and requests; beyond it the answer is 503."""

LOG_SECONDS = 60.0
_next: dict[tuple[str, int], float] = {}
"""When the next warning of a place in the code is logged."""

END_SECONDS = 5
"""Time in which open requests end after Ctrl-C."""


class SecurityMiddleware:
    """Refuses requests before any page sees them, and sets the headers of every answer.

    ``host`` is the address that the server listens at.
    """

    def __init__(self, app: ASGIApp, host: str = "127.0.0.1") -> None:
        self._app = app
        self._host = host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        refusal = self._refusal(scope)
        answer = self._app if refusal is None else _plain(scope["path"], *refusal)
        await answer(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        method, allowed = scope["method"], _methods(scope["path"])
        if method not in allowed:
            return 405, f"{method} is not answered here: use {allowed[0]}.\n"
        if not is_own(headers.getlist("host"), self._host):
            return 421, (
                "The Host header names another server: open the address that the command printed.\n"
            )
        if headers.get("sec-fetch-site") == "cross-site" and not _is_visit(headers):
            return 403, "Another web site asked for this: open the page itself.\n"
        if method == "POST" and not _is_own_form(headers):
            return 403, "Another web site sent this form: open the page SQL and send its own.\n"
        if len(scope["query_string"]) > LONGEST_QUERY:
            return 414, f"The address is too long, at most {LONGEST_QUERY} bytes after the '?'.\n"
        return None


def _methods(path: str) -> tuple[str, ...]:
    if _STATEMENTS.fullmatch(path) is None:
        return METHODS
    return (*METHODS, "POST") if path == "/sql" else ("POST",)


def _plain(path: str, status: int, text: str) -> PlainTextResponse:
    headers = {"allow": ", ".join(_methods(path))} if status == 405 else None
    return PlainTextResponse(text, status, headers)


def _is_own_form(headers: Headers) -> bool:
    """Return True if the browser says that a page of this server sent the form, or says nothing.

    Under the referrer policy of these pages the origin of a form is "null". The token decides in
    any case.
    """
    site, origin = headers.get("sec-fetch-site"), headers.get("origin", "null")
    own = f"://{headers['host']}"
    return site in ("same-origin", "none", None) and (origin == "null" or origin.endswith(own))


def _is_visit(headers: Headers) -> bool:
    """Return True if the user followed a link, which shows a page and tells the site nothing."""
    return headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") in (
        "document",
        None,
    )


def is_own(hosts: list[str], listening: str) -> bool:
    """Return True if the Host header is one that a browser sends when it means this server.

    A name that somebody else may own is never accepted. An address is, since no name stands for
    it: any address where the server listens beyond this machine, else a loopback address.
    """
    if len(hosts) != 1:
        return False
    name = _name(hosts[0])
    if name is None:
        return False
    if name in ("localhost", listening.lower()):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return address.is_loopback or not is_loopback(listening)


def _name(host: str) -> str | None:
    """Return the Host header without its port and brackets; None where it is malformed."""
    found = re.fullmatch(r"(?:\[([^\]]*)\]|([^:\[]*))(?::[0-9]*)?", host)
    return ((found[1] or found[2] or "").lower() or None) if found else None


class Connection(H11Protocol):
    """HTTP connection that is closed when its next request does not come whole and in time."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # uvicorn narrows it
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
    """Server that ends event streams before it waits for connections to close."""

    def __init__(self, app: Starlette, port: int = 8000) -> None:
        config = uvicorn.Config(
            app,
            port=port,
            log_level="warning",
            server_header=False,
            lifespan="on",
            http=Connection,
            ws="none",
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=END_SECONDS,
        )
        super().__init__(config)
        logging.getLogger("uvicorn.error").addFilter(seldom)
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what is open."""
        self._app.state.end()
        await super().shutdown(sockets)
