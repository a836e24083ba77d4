"""The form of the SQL page, as a client of the application sends it."""

from __future__ import annotations

import re

from httpx import Response
from starlette.testclient import TestClient


def token(client: TestClient) -> str:
    """Return the token of the form."""
    found = re.search(r'name="token" value="([\w-]+)"', client.get("/sql").text)
    assert found
    return found[1]


def post(client: TestClient, path: str, statement: str, **headers: str) -> Response:
    """Send a statement, with headers whose names have underscores for dashes."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return client.post(path, data={"q": statement, "token": token(client)}, headers=named)
