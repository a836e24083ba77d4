"""Security checks of every request: methods, own Host header, no cross-site requests.

A foreign web site may point a DNS name at 127.0.0.1 (DNS rebinding) or embed URLs of this server.
The Host header reveals the first, Sec-Fetch-Site the second; the response headers keep pages from
running or loading foreign content. Statements of the SQL page come by POST, from a form of this
server alone; a link shows a page and runs nothing.
"""

from __future__ import annotations

import ipaddress
import re

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from analysis.serve.addresses import is_loopback

METHODS = ("GET", "HEAD")
_STATEMENTS = re.compile(r"(/db/[^/]+)?(/sql|/api/sql(\.csv)?)")
LONGEST_QUERY = 16_000
"""Bytes of a query string; a long SQL statement has a few thousand."""

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "media-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


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
    found = _STATEMENTS.fullmatch(path)
    if found is None:
        return METHODS
    return (*METHODS, "POST") if found[2] == "/sql" else ("POST",)


def _plain(path: str, status: int, text: str) -> PlainTextResponse:
    headers = {"allow": ", ".join(_methods(path))} if status == 405 else None
    return PlainTextResponse(text, status, headers)


def _is_own_form(headers: Headers) -> bool:
    """Whether a browser says that a page of this server sent the form, or says nothing.

    Under the referrer policy of these pages the origin of a form is "null". The token decides in
    any case.
    """
    site, origin = headers.get("sec-fetch-site"), headers.get("origin", "null")
    own = f"://{headers['host']}"
    return site in ("same-origin", "none", None) and (origin == "null" or origin.endswith(own))


def _is_visit(headers: Headers) -> bool:
    """Whether the user followed a link to here, which shows a page and tells the site nothing."""
    return headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") in (
        "document",
        None,
    )


def is_own(hosts: list[str], listening: str) -> bool:
    """Whether the Host header is one that a browser sends when it means this server.

    A name that somebody else may own is never accepted. An address is, since no name stands for
    it: any address where the server listens beyond this machine, else that of this machine.
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
    if host.startswith("["):
        name, bracket, port = host[1:].partition("]")
        if not bracket or (port and not port.startswith(":")):
            return None
        port = port[1:]
    else:
        name, _, port = host.partition(":")
    if port and not (port.isascii() and port.isdigit()):
        return None
    return name.lower() or None
