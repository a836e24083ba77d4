"""Ask the head of a Ray cluster each second whether it lives, and how many cores there are.

Without its head a cluster goes on for a while and then ends the launch with no Python exception;
we want to know before that. Ray may wait for a silent head for as long as it likes, so a thread of
its own asks, and the launch only looks at what it has heard.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import ray

from orchestrate.errors import InfrastructureError

PERIOD_SECONDS = 1.0
SILENCE_SECONDS = 3.0
"""A head that does not answer for so long is lost; Ray has been seen to end us after 5 s."""

NO_CORES_SECONDS = 60.0
"""Time in which a cluster without cores may get some."""


class ClusterWatch:
    """Asks the head at ``address``, HOST:PORT, from a thread.

    Attributes
    ----------
    cores : int
        Cores of the nodes that live, as the head last said.
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
        """Raise ``InfrastructureError`` if the head is silent, or all nodes are gone."""
        now = time.monotonic()
        # A launch that was itself stopped for a while has heard nothing, which proves nothing.
        self._silence += min(now - self._checked, PERIOD_SECONDS / 2)
        self._checked = now
        if self._answers != self._heard:
            self._heard, self._silence = self._answers, 0.0
        if self._silence > SILENCE_SECONDS:
            raise InfrastructureError(
                f"The head of the Ray cluster at {self._address} has not answered for "
                f"{SILENCE_SECONDS:.0f} s: when it is back, run the same command again to go on."
            )
        if self.cores:
            self._no_cores_since = now
        if now - self._no_cores_since > NO_CORES_SECONDS:
            raise InfrastructureError(
                f"The Ray cluster at {self._address} has had no cores for {NO_CORES_SECONDS:.0f} "
                "s: start nodes that join it, and run the same command again to go on."
            )

    def stop(self) -> None:
        """Ask no more."""
        self._over.set()
        self._thread.join(timeout=PERIOD_SECONDS)

    def _ask(self) -> None:
        host, port = self._address.rsplit(":", 1)
        while not self._over.is_set():
            with contextlib.suppress(Exception):  # whatever it is, it is no answer
                # Ray itself would wait for a head that is gone.
                socket.create_connection((host, int(port)), PERIOD_SECONDS).close()
                self.cores = _cores()
                self._answers += 1
            self._over.wait(PERIOD_SECONDS)


def _cores() -> int:
    nodes = ray.nodes()  # type: ignore[no-untyped-call]
    return int(sum(node["Resources"].get("CPU", 0) for node in nodes if node["Alive"]))
