"""Programs on the hosts of a lab: Ray nodes, a PostgreSQL server, launches."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.machines.hosts import Host, Process
from tests.paths import ROOT

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
