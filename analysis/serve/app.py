"""Routes of the results browser: pages, the JSON behind each page, and CSV tables."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Any
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from analysis.serve import is_loopback, pages, sql
from analysis.serve.server import LONGEST_QUERY, SecurityMiddleware
from analysis.serve.web import (
    FOLDER,
    BusyError,
    Database,
    ForbiddenError,
    NotFoundError,
    QueryParams,
    RequestError,
    ServerState,
    as_csv,
    as_json,
    as_page,
)
from dopt.errors import DoptError
from orchestrate.store.errors import NoDatabaseError, SchemaVersionError, StoreUnavailableError

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
STATES = (
    ((NoDatabaseError, SchemaVersionError, StoreUnavailableError), 503),
    ((BusyError,), 429),
    ((NotFoundError,), 404),
    ((ForbiddenError,), 403),
    ((DoptError,), 400),
)


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
            Route("/api/events", partial(_events, state)),
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


async def _events(state: ServerState, request: Request) -> Response:
    return state.events.respond(request)


def _curves_table(state: ServerState, request: Request) -> Response:
    return as_csv(pages.curves_table(state, _query_params(request)), "curves")


def _error_response(state: ServerState, request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        status = next(code for kinds, code in STATES if isinstance(error, kinds))
        return _message(state, request, status, str(error))
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
