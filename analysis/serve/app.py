"""Routes of the results browser: pages, the JSON behind each page, and CSV tables."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from analysis.serve import compare, control, curves, gallery, grid, launches, sql, trial, trials
from analysis.serve.addresses import is_loopback
from analysis.serve.errors import BusyError, ForbiddenError, NotFoundError, RequestError
from analysis.serve.events import respond
from analysis.serve.query_params import QueryParams
from analysis.serve.responses import FOLDER, as_csv, as_json, as_page
from analysis.serve.security import LONGEST_QUERY, SecurityMiddleware
from analysis.serve.side_by_side import side_by_side
from analysis.serve.sites import state_at, states_of
from analysis.serve.state import ServerState
from dopt.errors import DoptError
from orchestrate.store.errors import (
    NoDatabaseError,
    SchemaVersionError,
    StoreUnavailableError,
)

Numbers = Callable[[ServerState, QueryParams], Mapping[str, Any]]
Answer = Callable[[ServerState, Request, QueryParams, sql.Stopped], Response]

FORM_SECONDS = 10.0
"""Time in which a form has to arrive."""

PAGES: tuple[tuple[str, str, Numbers], ...] = (
    ("/", "grid", grid.grid),
    ("/curves", "curves", curves.choices),
    ("/trials", "trials", trials.trials),
    ("/trials/{trial_key}", "trial", trial.trial),
    ("/compare", "compare", compare.compare),
    ("/control", "control", control.control),
    ("/launches", "launches", launches.launches),
    ("/figures", "figures", gallery.gallery),
    ("/sql", "sql", sql.form),
)
DATA: tuple[tuple[str, Numbers], ...] = (
    ("/api/grid", grid.grid),
    ("/api/curves", curves.curves),
    ("/api/trials", trials.trials),
    ("/api/trials/{trial_key}", trial.trial),
    ("/api/trials/{trial_key}/arrays", trial.arrays),
    ("/api/trials/{trial_key}/samples", trial.samples),
    ("/api/compare", compare.compare),
    ("/api/control", control.control),
    ("/api/launches", launches.launches),
    ("/api/figures", gallery.gallery),
)
TABLES: dict[str, Callable[[ServerState, QueryParams], str]] = {
    "curves": lambda state, params: curves.table(state, params).to_csv(index=False),
    "compare": lambda state, params: compare.table(state, params).to_csv(index=False),
    "control": lambda state, params: control.table(state, params).to_csv(index=False),
}
STATES = (
    ((NoDatabaseError, SchemaVersionError, StoreUnavailableError), 503),
    ((BusyError,), 429),
    ((NotFoundError,), 404),
    ((ForbiddenError,), 403),
    ((DoptError,), 400),
)


def create_app(
    url: str, figures: Path, host: str = "127.0.0.1", others: Sequence[str] = ()
) -> Starlette:
    """Return the application for a database, ``others`` beside it, and a folder of figures.

    ``host`` is the address that the server listens at. Raises ``StoreError`` for an invalid
    database URL. A database that does not exist yet gives an error page until it is created.
    """
    states = states_of([url, *others], figures, not is_loopback(host))
    routes = [
        Route("/databases", partial(_both, states)),
        Route("/api/databases", partial(_both_data, states)),
        Mount("/static", StaticFiles(directory=FOLDER / "static")),
        *(Mount(state.base, routes=_routes(state)) for state in states[1:]),
        *_routes(states[0]),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        for state in states:
            state.database.close()

    app = Starlette(
        routes=routes,
        middleware=[Middleware(SecurityMiddleware, host=host)],
        exception_handlers={
            DoptError: partial(_error_response, states),
            HTTPException: partial(_error_response, states),
            Exception: partial(_server_error, states),
        },
        lifespan=lifespan,
    )
    app.state.events = [state.events for state in states]
    return app


def end_streams(app: Starlette) -> None:
    """End event streams and statements, with which open pages keep the server from ending."""
    for events in app.state.events:
        events.end()


def _routes(state: ServerState) -> list[Route]:
    """Return the pages of one database, and what is behind them."""
    return [
        *(Route(path, partial(_page, state, name, numbers)) for path, name, numbers in PAGES),
        *(Route(path, partial(_data, state, numbers)) for path, numbers in DATA),
        *(Route(f"/api/{name}.csv", partial(_table, state, name)) for name in TABLES),
        *(Route(path, partial(_ask, state, to), methods=["POST"]) for path, to in STATEMENTS),
        Route("/api/events", partial(_events, state)),
        Route("/figures/{name}", partial(_file, state)),
    ]


def _query_params(request: Request) -> QueryParams:
    return QueryParams({**dict(request.query_params), **request.path_params})


def _page(state: ServerState, name: str, numbers: Numbers, request: Request) -> Response:
    content = numbers(state, _query_params(request))
    status = 400 if content.get("error") else 200
    return as_page(f"{name}.html", _page_context(state, name, request) | dict(content), status)


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


def _both(states: Sequence[ServerState], request: Request) -> Response:
    content = side_by_side(states, _query_params(request))
    return as_page("databases.html", _page_context(states[0], "databases", request) | content)


def _both_data(states: Sequence[ServerState], request: Request) -> Response:
    return as_json(side_by_side(states, _query_params(request)))


async def _events(state: ServerState, request: Request) -> Response:
    return respond(state.events, request)


def _table(state: ServerState, name: str, request: Request) -> Response:
    return as_csv(TABLES[name](state, _query_params(request)), name)


def _file(state: ServerState, request: Request) -> Response:
    path = gallery.find(state, request.path_params["name"])
    return FileResponse(path, media_type=gallery.TYPES[path.suffix[1:]])


class QueryText(dict[str, str]):
    """Query parameters as text; a missing parameter is the empty string."""

    def __missing__(self, key: str) -> str:
        return ""


def _page_context(state: ServerState, name: str, request: Request) -> dict[str, Any]:
    """Return the content that every page shows beside its own."""
    query = QueryText({key: value for key, value in request.query_params.items() if value})
    return {"query": query, **_frame(state, name)}


def _frame(state: ServerState, name: str) -> dict[str, Any]:
    """Return what the menus of a page need; ``here`` is its path under each database."""
    paths = {name: path for path, name, _ in PAGES} | {"trial": "/trials"}
    return {
        "page": name,
        "here": paths.get(name, "/"),
        "base": state.base,
        "databases": state.links,
        "database": state.database.safe_url,
    }


def _error_response(states: Sequence[ServerState], request: Request, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        sentence = (
            "This page does not exist: choose a page from the menu above."
            if error.status_code == 404
            else (f"{error.detail}.")
        )
        return _message(states, request, error.status_code, sentence)
    status = next(code for kinds, code in STATES if isinstance(error, kinds))
    return _message(states, request, status, str(error))


def _server_error(states: Sequence[ServerState], request: Request, error: Exception) -> Response:
    logging.getLogger(__name__).error("%r failed", request.scope["path"], exc_info=error)
    return _message(
        states,
        request,
        500,
        "This page failed: the server's terminal shows the traceback.",
    )


def _message(
    states: Sequence[ServerState], request: Request, status: int, sentence: str
) -> Response:
    state = state_at(states, request.scope["path"])
    path = request.scope["path"].removeprefix(state.base)
    if path.startswith("/api/"):
        return as_json({"error": sentence}, status)
    name = path.split("/")[1] or "grid"
    content = {"sentence": sentence, "status": status, "query": QueryText()}
    return as_page("message.html", _frame(state, name) | content, status)
