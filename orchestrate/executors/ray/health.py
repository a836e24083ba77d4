"""Health check of a Ray cluster: a thread queries its head each second.

Without its head a cluster continues for a while and then ends the launch with no Python exception;
the check detects the loss before that. A query may block for any time, so that a thread of its own
sends it, and the launch only reads the last answer.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import ray

from orchestrate.errors import InfrastructureError

QUERY_INTERVAL_SECONDS = 1.0
HEAD_TIMEOUT_SECONDS = 3.0
"""Time without an answer after which the head is lost; Ray ended launches after 5 s."""

NO_CORES_TIMEOUT_SECONDS = 60.0
"""Time for which a cluster may have no cores."""


class ClusterWatch:
    """Thread that queries the head at ``address``, HOST:PORT.

    Attributes
    ----------
    cores : int
        Cores of the living nodes at the last answer.
    """

    def __init__(self, address: str) -> None:
        self.cores = 0
        self._address = address
        self._answers = 0
        self._heard = 0
        self._silence = 0.0
        self._no_cores_since = self._checked = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="cluster watch", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise ``InfrastructureError`` if the head does not answer, or all nodes are gone."""
        now = time.monotonic()
        # A launch that was itself suspended got no answers either: its pause does not count.
        self._silence += min(now - self._checked, QUERY_INTERVAL_SECONDS / 2)
        self._checked = now
        if self._answers != self._heard:
            self._heard, self._silence = self._answers, 0.0
        if self._silence > HEAD_TIMEOUT_SECONDS:
            raise InfrastructureError(
                f"The head of the Ray cluster at {self._address} has not answered for "
                f"{HEAD_TIMEOUT_SECONDS:.0f} s: when it is back, run the same command again to "
                "continue."
            )
        if self.cores:
            self._no_cores_since = now
        if now - self._no_cores_since > NO_CORES_TIMEOUT_SECONDS:
            raise InfrastructureError(
                f"The Ray cluster at {self._address} has had no cores for "
                f"{NO_CORES_TIMEOUT_SECONDS:.0f} s: start nodes that join it, and run the same "
                "command again to continue."
            )

    def stop(self) -> None:
        """Stop the thread."""
        self._over.set()
        self._thread.join(timeout=QUERY_INTERVAL_SECONDS)

    def _ask(self) -> None:
        host, port = self._address.rsplit(":", 1)
        while not self._over.is_set():
            with contextlib.suppress(Exception):  # any error means "no answer"
                # Ray itself would wait for a lost head.
                socket.create_connection((host, int(port)), QUERY_INTERVAL_SECONDS).close()
                self.cores = _cores()
                self._answers += 1
            self._over.wait(QUERY_INTERVAL_SECONDS)


def _cores() -> int:
    nodes = ray.nodes()  # type: ignore[no-untyped-call]
    return int(sum(node["Resources"].get("CPU", 0) for node in nodes if node["Alive"]))
