"""The addresses of the browser: each page beside the JSON of the same numbers."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from analysis.errors import AnalysisError
from analysis.serve import compare, curves, gallery, grid, sql, trial, trials
from analysis.serve.answers import FOLDER, as_csv, as_json, as_page
from analysis.serve.asked import Asked
from analysis.serve.errors import BusyError, NotFoundError
from analysis.serve.guard import Guard
from analysis.serve.progress import measure
from analysis.serve.site import Site
from analysis.serve.source import Source
from dopt.errors import DoptError
from orchestrate.store.errors import (
    NoDatabaseError,
    SchemaVersionError,
    StoreUnavailableError,
)

Numbers = Callable[[Site, Asked], Mapping[str, Any]]

PAGES: tuple[tuple[str, str, Numbers], ...] = (
    ("/", "grid", grid.grid),
    ("/curves", "curves", curves.choices),
    ("/trials", "trials", trials.trials),
    ("/trials/{trial_key}", "trial", trial.trial),
    ("/compare", "compare", compare.compare),
    ("/figures", "figures", gallery.gallery),
    ("/sql", "sql", sql.sql),
)
DATA: tuple[tuple[str, Numbers], ...] = (
    ("/api/progress", lambda site, _: measure(site.source.reader())),
    ("/api/grid", grid.grid),
    ("/api/curves", curves.curves),
    ("/api/trials", trials.trials),
    ("/api/trials/{trial_key}", trial.trial),
    ("/api/trials/{trial_key}/arrays", trial.arrays),
    ("/api/compare", compare.compare),
    ("/api/figures", gallery.gallery),
    ("/api/sql", sql.sql),
)
TABLES: dict[str, Callable[[Site, Asked], str]] = {
    "curves": lambda site, asked: curves.table(site, asked).to_csv(index=False),
    "compare": lambda site, asked: compare.table(site, asked).to_csv(index=False),
    "sql": sql.table,
}
STATES = (
    ((NoDatabaseError, SchemaVersionError, StoreUnavailableError), 503),
    ((BusyError,), 429),
    ((NotFoundError,), 404),
    ((AnalysisError, DoptError), 400),
)


def create_app(url: str, figures: Path, host: str = "127.0.0.1") -> Starlette:
    """Return the application for a database and a folder of figures.

    ``host`` is the address that it is served at. Raises ``StoreError`` for a URL that names no
    database; one that is not there yet is shown as such.
    """
    site = Site(Source(url), figures)
    static = StaticFiles(directory=FOLDER / "static")
    routes = [
        *(Route(path, partial(_page, site, name, numbers)) for path, name, numbers in PAGES),
        *(Route(path, partial(_data, site, numbers)) for path, numbers in DATA),
        *(Route(f"/api/{name}.csv", partial(_table, site, name)) for name in TABLES),
        Route("/figures/{name}", partial(_file, site)),
        Mount("/static", static),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        site.source.close()

    return Starlette(
        routes=routes,
        middleware=[Middleware(Guard, host=host)],
        exception_handlers={
            AnalysisError: partial(_refused, site),
            DoptError: partial(_refused, site),
            HTTPException: partial(_refused, site),
            Exception: partial(_broken, site),
        },
        lifespan=lifespan,
    )


def _asked(request: Request) -> Asked:
    return Asked({**dict(request.query_params), **request.path_params})


def _page(site: Site, name: str, numbers: Numbers, request: Request) -> Response:
    content = numbers(site, _asked(request))
    status = 400 if content.get("error") else 200
    return as_page(f"{name}.html", _frame(site, name, request) | dict(content), status)


def _data(site: Site, numbers: Numbers, request: Request) -> Response:
    content = numbers(site, _asked(request))
    return as_json(content, 400 if content.get("error") else 200)


def _table(site: Site, name: str, request: Request) -> Response:
    return as_csv(TABLES[name](site, _asked(request)), name)


def _file(site: Site, request: Request) -> Response:
    path = gallery.find(site, request.path_params["name"])
    return FileResponse(path, media_type=gallery.TYPES[path.suffix[1:]])


class Given(dict[str, str]):
    """What the address asks for, empty where it does not say."""

    def __missing__(self, key: str) -> str:
        return ""


def _frame(site: Site, name: str, request: Request) -> dict[str, Any]:
    """Return what every page shows around its numbers."""
    asked = Given({key: value for key, value in request.query_params.items() if value})
    return {"page": name, "asked": asked, "database": site.source.safe_url}


def _refused(site: Site, request: Request, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        sentence = (
            "There is no such page: choose one above."
            if error.status_code == 404
            else (f"{error.detail}.")
        )
        return _message(site, request, error.status_code, sentence)
    status = next(code for kinds, code in STATES if isinstance(error, kinds))
    return _message(site, request, status, str(error))


def _broken(site: Site, request: Request, error: Exception) -> Response:
    logging.getLogger(__name__).error("%s failed", request.scope["path"], exc_info=error)
    return _message(site, request, 500, "This page failed: the terminal of the server says why.")


def _message(site: Site, request: Request, status: int, sentence: str) -> Response:
    path = request.scope["path"]
    if path.startswith("/api/"):
        return as_json({"error": sentence}, status)
    name = path.split("/")[1] or "grid"
    content = {"sentence": sentence, "status": status, "page": name, "asked": Given()}
    return as_page("message.html", content | {"database": site.source.safe_url}, status)
