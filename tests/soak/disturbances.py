"""Disturbances of a launch in the soak, and the supervisor that causes them one after the other."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from sqlalchemy.engine import make_url
from tabulate import tabulate

from tests.orchestrate.faults.laboratory import Laboratory, Launched, Server

GOES_ON = (0,)
"""It ends only when the grid is complete."""

GIVES_UP = (0, 75)
"""It may find that something below it is gone for good."""

ENDED_BY_RAY = "Failed to register worker to Raylet"
"""Ray writes this and ends the driver with 1, without an exception, if its raylet dies then."""


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


EXECUTORS = ("local", "local", "local", "inprocess", "local", "ray")
"""In turn, from one start to the next."""

PAUSE_SECONDS = (0.5, 2.5)


@dataclass
class Supervisor:
    """Brings a grid to its end in spite of everything.

    Attributes
    ----------
    seen
        How often each disturbance was followed by what.
    """

    laboratory: Laboratory
    server: Server | None
    disturbances: Sequence[Disturbance]
    chance: random.Random
    seen: dict[str, Counter[str]] = field(default_factory=dict)
    starts: int = 0
    deck: list[Disturbance] = field(default_factory=list)

    def run(self) -> None:
        """Start launches until one of them says that all is done."""
        code = -1
        while code != 0:
            executor = EXECUTORS[self.starts % len(EXECUTORS)]
            self.starts += 1
            with self.laboratory.launched(executor=executor) as launched:
                code = self._disturb(launched)

    def _disturb(self, launched: Launched) -> int:
        """Disturb the launch until it ends; return its exit code."""
        allowed = {0}
        scene = Scene(self.laboratory, launched, self.server, self.chance)
        while not self._ends_within(launched, self.chance.uniform(*PAUSE_SECONDS)):
            disturbance = self._draw()
            allowed |= set(disturbance.codes)
            self._cause(disturbance, scene)
        code = launched.end()
        if ENDED_BY_RAY in launched.errors and GIVES_UP[-1] in allowed:
            allowed.add(1)
        assert code in allowed, f"exit code {code}: {launched.said}{launched.errors}"
        assert "Traceback" not in launched.errors, launched.errors
        return code

    def _draw(self) -> Disturbance:
        """Return each disturbance once, in a random order, before any of them comes again."""
        if not self.deck:
            self.deck = self.chance.sample(self.disturbances, len(self.disturbances))
        return self.deck.pop()

    def _cause(self, disturbance: Disturbance, scene: Scene) -> None:
        disturbance.cause(scene)
        launched = scene.launched
        ended = self._ends_within(launched, 0.5)
        what = f"exit code {launched.end()}" if ended else "went on"
        self.seen.setdefault(disturbance.name, Counter())[what] += 1

    @staticmethod
    def _ends_within(launched: Launched, seconds: float) -> bool:
        launched.process.join(seconds)
        return not launched.process.is_alive()

    def table(self) -> str:
        """Return what was done, how often, and what came of it."""
        rows = [
            (name, sum(seen.values()), ", ".join(f"{n} {what}" for what, n in seen.most_common()))
            for name, seen in sorted(self.seen.items())
        ]
        return tabulate(rows, headers=["fault", "times", "the launch"], tablefmt="github")
