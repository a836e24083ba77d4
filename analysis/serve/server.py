"""Web server of the results browser."""

from __future__ import annotations

import socket

import uvicorn
from starlette.applications import Starlette

from analysis.serve.app import end_streams


class Server(uvicorn.Server):
    """Server that ends the event streams before it waits for open connections to close."""

    def __init__(self, app: Starlette, port: int = 8000) -> None:
        config = uvicorn.Config(
            app, port=port, log_level="warning", server_header=False, lifespan="on"
        )
        super().__init__(config)
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what is open."""
        end_streams(self._app)
        await super().shutdown(sockets)
