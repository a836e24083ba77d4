"""Disturbances of a launch in the soak; each says how it must go on, or end."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

from sqlalchemy.engine import make_url

from tests.orchestrate.faults.laboratory import Laboratory, Launched
from tests.orchestrate.faults.servers import Server

GOES_ON = (0,)
"""It ends only when the grid is complete."""

GIVES_UP = (0, 75)
"""It may find that something below it is gone for good."""


@dataclass(frozen=True)
class Scene:
    """A launch that runs, where it runs, and chance."""

    laboratory: Laboratory
    launched: Launched
    server: Server | None
    chance: random.Random

    def rest(self, longest: float) -> None:
        time.sleep(self.chance.uniform(0.2, longest))


@dataclass(frozen=True)
class Disturbance:
    """A fault, and the exit codes with which the launch may end after it."""

    name: str
    cause: Callable[[Scene], None]
    codes: tuple[int, ...]


def kill_driver(scene: Scene) -> None:
    scene.launched.kill()


def kill_worker(scene: Scene) -> None:
    """Kill a process that the driver has started; under Ray that is a part of Ray."""
    workers = scene.launched.workers()
    if workers:
        os.kill(scene.chance.choice(workers), signal.SIGKILL)


def interrupt(scene: Scene) -> None:
    scene.launched.send(signal.SIGINT)
    scene.launched.end()


def interrupt_twice(scene: Scene) -> None:
    scene.launched.send(signal.SIGINT)
    time.sleep(0.1)
    if scene.launched.process.is_alive():
        scene.launched.send(signal.SIGINT)
    scene.launched.end()


def sleep_while_another_runs(scene: Scene) -> None:
    """Stop the driver for longer than a lease, and let another launch work meanwhile."""
    scene.launched.send(signal.SIGSTOP)
    with scene.laboratory.launched(executor="inprocess"):
        time.sleep(1.5 * scene.laboratory.order.settings["lease"])
    scene.launched.send(signal.SIGCONT)


def launch_another(scene: Scene) -> None:
    """Run a second launch at the same time, and kill it in the middle."""
    with scene.laboratory.launched():
        scene.rest(6.0)


def lock_the_file(scene: Scene) -> None:
    """Keep everybody from writing, as another program with the file open would."""
    path = str(make_url(scene.laboratory.url).database)
    with closing(sqlite3.connect(path, timeout=30.0, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        scene.rest(3.0)


def end_connections(scene: Scene) -> None:
    for _ in range(3):
        _server(scene).terminate_backends()
        scene.rest(0.5)


def restart_fast(scene: Scene) -> None:
    _server(scene).restart("fast")


def restart_immediately(scene: Scene) -> None:
    _server(scene).restart("immediate")


def stop_server(scene: Scene) -> None:
    """Stop the server for longer than the launch has patience."""
    server = _server(scene)
    server.stop()
    try:
        scene.launched.end()
    finally:
        server.start()


def _server(scene: Scene) -> Server:
    assert scene.server is not None
    return scene.server


ANYWHERE = (
    Disturbance("kill -9 of the driver", kill_driver, (0, -9)),
    Disturbance("kill -9 of a worker, or of a part of Ray", kill_worker, GIVES_UP),
    Disturbance("Ctrl-C", interrupt, (0, 130)),
    Disturbance("Ctrl-C twice", interrupt_twice, (0, 130)),
    Disturbance(
        "SIGSTOP past the lease, another launch meanwhile", sleep_while_another_runs, GOES_ON
    ),
    Disturbance("a second launch, killed", launch_another, GOES_ON),
)
ON_SQLITE = (*ANYWHERE, Disturbance("the file locked by another program", lock_the_file, GOES_ON))
ON_POSTGRESQL = (
    *ANYWHERE,
    Disturbance("every connection ended, three times", end_connections, GOES_ON),
    Disturbance("server restarted fast", restart_fast, GIVES_UP),
    Disturbance("server restarted immediately", restart_immediately, GIVES_UP),
    Disturbance("server stopped for longer than the patience", stop_server, GIVES_UP),
)
