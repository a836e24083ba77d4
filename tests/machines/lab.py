"""A PostgreSQL server, a Ray cluster and a desk to launch from, each on a host of its own."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.machines import servers
from tests.machines.hosts import Host, Network, Process, until
from tests.machines.outcome import Outcome
from tests.machines.witness import PAUSE

GRID = ("env=pendulum", "policy=d_optimal", "width=32")
SEEDS = 24
SECONDS_PER_TRIAL = 0.5
"""Least time that a witness adds to a trial, so that a fault meets an unfinished grid."""


class Lab:
    """Hosts of a network by their names; ``desk`` has no cores for trials.

    Attributes
    ----------
    network : Network
        Where links are cut and hosts end.
    address : str
        HOST:PORT of the head, once there is one.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self.database = servers.Database(network.add("db"))
        self.address = ""

    def host(self, name: str) -> Host:
        """Return the host of the name, the newest one."""
        return self.network.hosts[name] if name in self.network.hosts else self.network.add(name)

    def start_cluster(self, *workers: str, **environment: str) -> None:
        """Start the head, then let the desk and the workers, with a core each, join it at once."""
        self.address = servers.start_head(self.host("head"), 0, **environment)
        cores = {self.host("desk"): 0} | {self.host(worker): 1 for worker in workers}
        with ThreadPoolExecutor() as threads:
            joined = [
                threads.submit(servers.join, host, self.address, count, **environment)
                for host, count in cores.items()
            ]
        for one in joined:
            one.result()

    def add_worker(self, name: str, **environment: str) -> None:
        servers.join(self.host(name), self.address, 1, **environment)

    def launch(
        self, *words: str, seeds: int = SEEDS, on: str = "desk", witness: bool = False,
        **environment: str,
    ) -> Process:  # fmt: skip
        """Start a launch of the grid, on the cluster if there is one, else in a pool.

        A launch into which a fault is to fall has a witness, which gives its trials a length.
        """
        where = ["executor=local", "launch.workers=1"]
        if self.address:
            where = ["executor=ray", f"launch.ray.address={self.address}"]
        grid = (*GRID, f"seed=range({seeds})", "launch.chunk_seconds=0.5")
        program = servers.WITNESS if witness else servers.LAUNCH
        words = (f"store.url={self.database.url}", *grid, *where, *words)
        return servers.launch(self.host(on), program, *words, **environment)

    def until_done(self, launched: Process, count: int) -> None:
        """Wait until so many trials are done, or the launch has ended."""
        until(
            lambda: self.done() >= count or not launched.running, 120.0,
            lambda: f"{count} done trials:\n{launched.output}",
        )  # fmt: skip
        assert launched.running, launched.output

    def until_rows(self, launched: Process, table: str, condition: str) -> float:
        """Wait until there is such a row; return how many seconds that took."""
        return until(
            lambda: self.count(table, condition) > 0, 60.0,
            lambda: f"{table} with {condition}:\n{launched.output}",
        )  # fmt: skip

    def until_head_lost(self, name: str) -> None:
        """Wait until the head of the cluster takes a worker for dead."""
        given = (self.address, self.host("head").address, self.host(name).address)
        self.host("head").run(sys.executable, "-c", servers.UNTIL_DEAD, *given, seconds=150.0)

    def done(self) -> int:
        """Return how many trials are done, -1 while the server does not say."""
        return self.count("trial", "status = 'done'")

    def count(self, table: str, condition: str) -> int:
        """Return how many rows there are, -1 while the server does not say."""
        answer = self.ask(f"SELECT count(*) FROM {table} WHERE {condition}")
        return int(answer) if answer.isdigit() else -1

    def ask(self, sql: str) -> str:
        """Return what ``psql`` says to a query, errors included."""
        host = self.host("db")
        words = ["psql", "-h", "/tmp", "-U", "postgres", "-Atc", sql]
        process = host.start(*words)
        process.wait(30.0)
        return process.output.strip()

    def outcome(self) -> Outcome:
        """Return all that is in the database."""
        command = (sys.executable, "-m", "tests.machines.outcome", self.database.url)
        return Outcome.from_json(self.host("db").run(*command))


def environment() -> dict[str, str]:
    """Return what every program on every host is given."""
    cache = os.environ.get("DOPT_CACHE") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return {
        "PYTHONPATH": str(servers.ROOT),
        "DOPT_CACHE": str(Path(cache).expanduser()),  # nobody compiles again
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        PAUSE: str(SECONDS_PER_TRIAL),
    }
