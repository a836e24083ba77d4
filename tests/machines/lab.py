"""Lab: a PostgreSQL server, a Ray cluster and a desk to launch from, each on a host of its own.

``python -m tests.machines.lab URL`` prints all that a launch has left in a database, as JSON. It
runs where the database can be reached, and names no time and no node of a result, which differ.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrate.store import Reader
from tests.machines.hosts import Host, Network, Process, until
from tests.machines.witness import PAUSE
from tests.paths import ROOT

Row = tuple[Any, ...]

_QUERIES = {
    "curves": "SELECT seed, t, loss, reachable_loss FROM v_curve ORDER BY seed, t",
    "trials": (
        "SELECT seed, status, n_steps, final_loss, best_loss, diverged_at FROM trial ORDER BY seed"
    ),
    "trajectories": (
        "SELECT trial.seed, states, inputs, parameters FROM trajectory "
        "JOIN trial USING (trial_id) ORDER BY trial.seed"
    ),
    "attempts": (
        "SELECT seed, attempt.attempt, outcome, cause, attempt.node, attempt.launch_id, "
        "attempt.ended FROM attempt JOIN trial USING (trial_id) ORDER BY seed, attempt.attempt"
    ),
    "nodes": "SELECT node, count(*) FROM trial GROUP BY node ORDER BY node",
    "launches": "SELECT launch_id, state FROM launch ORDER BY launch_id",
}


@dataclass(frozen=True)
class Outcome:
    """Rows of the database; a long text of bytes is its digest."""

    curves: list[Row]
    trials: list[Row]
    trajectories: list[Row]
    attempts: list[Row]
    nodes: list[Row]
    launches: list[Row]

    @classmethod
    def from_json(cls, text: str) -> Outcome:
        return cls(**{key: [tuple(row) for row in rows] for key, rows in json.loads(text).items()})

    @property
    def results(self) -> list[list[Row]]:
        """What must be the same for every run of the grid, row by row and bit by bit."""
        return [self.trials, self.curves, self.trajectories]

    def check_complete(self, undisturbed: Outcome, seeds: int | None = None) -> None:
        """Check that the first trials, or all, are there once, as they are where nothing happens.

        A second outcome of a trial would be a second row of its steps, or an attempt too many.
        """
        count = len(undisturbed.trials) if seeds is None else seeds
        expected = [[row for row in rows if row[0] < count] for rows in undisturbed.results]
        assert self.results == expected
        done = [seed for seed, _, outcome, *_ in self.attempts if outcome == "done"]
        assert done == list(range(count))

    def attempts_of(self, outcome: str) -> dict[int, Row]:
        """Return the rows of the first attempts, by seed, that ended so."""
        return {row[0]: row for row in reversed(self.attempts) if row[2] == outcome}


def read(url: str) -> dict[str, list[list[Any]]]:
    """Return the rows of each query."""
    with Reader.open(url) as reader:
        return {
            key: [[_plain(value) for value in row] for row in reader.rows(sql)]
            for key, sql in _QUERIES.items()
        }


def _plain(value: Any) -> Any:
    if isinstance(value, bytes | memoryview):
        return hashlib.sha256(bytes(value)).hexdigest()
    return value


RAY = (sys.executable, "-m", "ray.scripts.scripts")
LAUNCH = (str(ROOT / "orchestrate/launch.py"),)
WITNESS = ("-m", "tests.machines.witness")
RAY_PORT = 6379
OBJECT_STORE_BYTES = 100_000_000

UNTIL_DEAD = """
import sys, time, ray
cluster, own, other = sys.argv[1:]
ray.init(cluster, _node_ip_address=own, log_to_driver=False)
while any(node["Alive"] and node["NodeManagerAddress"] == other for node in ray.nodes()):
    time.sleep(0.2)
"""
"""Program for a host of a cluster that ends when the head takes another host for dead."""


def ray_settings() -> dict[str, str]:
    """Return the settings that users give to every node of a cluster."""
    text = (ROOT / "orchestrate/executors/ray/ray.env").read_text()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return dict(line.split("=", 1) for line in lines)


def start_head(host: Host, cpus: int = 1, **environment: str) -> str:
    """Start the head of a cluster on a host and return the address that others join."""
    _ray_start(host, cpus, "--head", f"--port={RAY_PORT}", "--include-dashboard=false",
               "--no-monitor", **environment)  # fmt: skip
    return f"{host.address}:{RAY_PORT}"


def join(host: Host, address: str, cpus: int = 1, **environment: str) -> None:
    """Let a host join the cluster."""
    _ray_start(host, cpus, f"--address={address}", **environment)


def _ray_start(host: Host, cpus: int, *words: str, **environment: str) -> None:
    host.run(
        *RAY, "start", *words, f"--node-ip-address={host.address}",
        f"--num-cpus={cpus}", f"--object-store-memory={OBJECT_STORE_BYTES}",
        "--disable-usage-stats", "--include-log-monitor=false", **{**ray_settings(), **environment},
    )  # fmt: skip


class Database:
    """A PostgreSQL server of its own on a host."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._bin = sorted(Path("/usr/lib/postgresql").glob("*/bin"))[-1]
        self._data = host.folder / "postgresql"
        self._data.mkdir()
        shutil.chown(self._data, "postgres", "postgres")
        self._run("initdb", "--no-sync", "--auth=trust", "--encoding=UTF8", "--no-locale")
        with (self._data / "pg_hba.conf").open("a") as rules:
            rules.write("host all all 10.77.0.0/24 trust\n")
        with (self._data / "postgresql.conf").open("a") as settings:
            settings.write("listen_addresses = '*'\nunix_socket_directories = '/tmp'\n")
        self.start()
        self.url = f"postgresql+psycopg://postgres@{host.address}:5432/postgres"

    def start(self) -> None:
        self._control("start")

    def stop(self, mode: str) -> None:
        """Stop the server as an administrator does: ``fast`` or ``immediate``."""
        self._control("stop", "-m", mode)

    def _control(self, *words: str) -> None:
        self._run("pg_ctl", *words, "--wait", f"--log={self._data / 'server.log'}")

    def _run(self, program: str, *words: str) -> None:
        self._host.run("runuser", "-u", "postgres", "--", str(self._bin / program),
                       f"--pgdata={self._data}", *words)  # fmt: skip


def leave(host: Host) -> None:
    """End all that runs of Ray on a host."""
    host.run(*RAY, "stop", "--force")


def launch(host: Host, program: Sequence[str], *words: str, **environment: str) -> Process:
    """Start ``python orchestrate/launch.py -m ...`` on a host."""
    settings = {**ray_settings(), **environment}
    return host.start(sys.executable, *program, "-m", *words, **settings)


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
        self.database = Database(network.add("db"))
        self.address = ""

    def host(self, name: str) -> Host:
        """Return the host of the name, the newest one."""
        return self.network.hosts[name] if name in self.network.hosts else self.network.add(name)

    def start_cluster(self, *workers: str, **environment: str) -> None:
        """Start the head, then let the desk and the workers, with a core each, join it at once."""
        self.address = start_head(self.host("head"), 0, **environment)
        cores = {self.host("desk"): 0} | {self.host(worker): 1 for worker in workers}
        with ThreadPoolExecutor() as threads:
            joined = [
                threads.submit(join, host, self.address, count, **environment)
                for host, count in cores.items()
            ]
        for one in joined:
            one.result()

    def add_worker(self, name: str, **environment: str) -> None:
        join(self.host(name), self.address, 1, **environment)

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
        program = WITNESS if witness else LAUNCH
        words = (f"store.url={self.database.url}", *grid, *where, *words)
        return launch(self.host(on), program, *words, **environment)

    def until_done(self, launched: Process, count: int) -> None:
        """Wait until so many trials are done, or the launch has ended."""
        until(
            lambda: self.done() >= count or not launched.running,
            lambda: f"{count} done trials:\n{launched.output}",
        )  # fmt: skip
        assert launched.running, launched.output

    def until_rows(self, launched: Process, table: str, condition: str) -> float:
        """Wait until there is such a row; return how many seconds that took."""
        return until(
            lambda: self.count(table, condition) > 0,
            lambda: f"{table} with {condition}:\n{launched.output}",
        )  # fmt: skip

    def until_head_lost(self, name: str) -> None:
        """Wait until the head of the cluster takes a worker for dead."""
        given = (self.address, self.host("head").address, self.host(name).address)
        self.host("head").run(sys.executable, "-c", UNTIL_DEAD, *given)

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
        process.wait()
        return process.output.strip()

    def outcome(self) -> Outcome:
        """Return all that is in the database."""
        command = (sys.executable, "-m", "tests.machines.lab", self.database.url)
        return Outcome.from_json(self.host("db").run(*command))

    def completed(
        self, undisturbed: Outcome, *launches: Process, seeds: int | None = None
    ) -> Outcome:
        """Wait for the ends of launches, check that the first trials, or all, are done once."""
        for launched in launches:
            assert launched.wait() == 0, launched.output
        outcome = self.outcome()
        outcome.check_complete(undisturbed, seeds)
        return outcome


def environment() -> dict[str, str]:
    """Return what every program on every host is given."""
    cache = os.environ.get("DOPT_CACHE") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return {
        "PYTHONPATH": str(ROOT),
        "DOPT_CACHE": str(Path(cache).expanduser()),  # nobody compiles again
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        PAUSE: str(SECONDS_PER_TRIAL),
    }


if __name__ == "__main__":
    json.dump(read(sys.argv[1]), sys.stdout)
