"""Services of compose.yaml, run by podman-compose where ``make image`` has built the images."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

HEALTHY_SECONDS = 240.0
Ended = subprocess.CompletedProcess[str]


@dataclass(frozen=True)
class Machine:
    """One machine with a container engine.

    Attributes
    ----------
    root
        Folder of its copy of the repository.
    name
        Project that its containers belong to.
    variables
        Environment of its commands.
    prefix
        Words that run a command on that machine.
    """

    root: Path
    name: str
    variables: dict[str, str] = field(default_factory=dict)
    prefix: tuple[str, ...] = ()

    def run(self, *words: str, check: bool = True) -> Ended:
        """Run a command on the machine and return what it said."""
        settings = {"DISABLE_HC_SYSTEMD": "true", "DOPT_IMAGE": "localhost/dopt"}
        done = subprocess.run(
            [*self.prefix, *words],
            env={**os.environ, **settings, **self.variables},
            cwd=self.root,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if check and done.returncode:
            said = f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
            raise AssertionError(f"{' '.join(words)} ended with {done.returncode}:\n{said}")
        return done

    def compose(self, *words: str, check: bool = True) -> Ended:
        """Run ``docker compose`` as docs/many_machines.md writes it."""
        command = (sys.executable, "-m", "podman_compose", "--project-name", self.name)
        # A service that is named needs no profile with Docker, and one with podman.
        profile = ("--profile", "tools") if words[0] == "run" or words[-1] == "browser" else ()
        terminal = ("-T",) if words[0] == "run" else ()
        return self.run(*command, *profile, words[0], *terminal, *words[1:], check=check)

    def containers(self, service: str = "") -> list[str]:
        """Return the names of this project's running containers, or of one service."""
        wanted = [f"label=io.podman.compose.project={self.name}"]
        wanted += [f"label=com.docker.compose.service={service}"] if service else []
        filters = [word for label in wanted for word in ("--filter", label)]
        return self.run("podman", "ps", "--format", "{{.Names}}", *filters).stdout.split()

    def inside(self, container: str, *words: str) -> str:
        """Run a command in a container and return its output."""
        return self.run("podman", "exec", container, *words).stdout.strip()

    def inspect(self, container: str) -> Any:
        """Return all that the engine knows of a container."""
        return json.loads(self.run("podman", "inspect", container).stdout)[0]

    def wait_until_healthy(self, service: str) -> None:
        """Wait until each container of a service passes its own health check."""
        containers = self.containers(service)
        assert containers, f"no container of {service} runs"
        deadline = time.monotonic() + HEALTHY_SECONDS
        for container in containers:
            while self.run("podman", "healthcheck", "run", container, check=False).returncode:
                assert time.monotonic() < deadline, self.logs(container)
                time.sleep(1)

    def logs(self, container: str) -> str:
        """Return what a container has said."""
        done = self.run("podman", "logs", container)
        return done.stdout + done.stderr

    def rows(self, sql: str) -> list[list[str]]:
        """Ask the database in its container."""
        (database,) = self.containers("db")
        words = ("psql", "--username=dopt", "--no-align", "--tuples-only", "--command", sql)
        return [line.split("|") for line in self.inside(database, *words).splitlines()]

    def spread(self, count: int) -> set[str]:
        """Launch grids until ``count`` nodes have run trials, and return the nodes' names.

        Which node runs a short trial is up to Ray; one that is slow to start may get none at first.
        """
        for first in range(100, 200, 20):
            nodes = {row[0] for row in self.rows("SELECT DISTINCT node FROM trial")}
            if len(nodes) >= count:
                break
            seeds = f"seed=range({first},{first + 20})"
            grid = ("launch", "-m", "experiment=smoke", "env.horizon=100", seeds)
            self.compose("run", "--rm", "launch", *grid, "launch.chunk_seconds=0.1")
        return nodes


PASSWORD = 'a:b\\c d"e@/f'
TOKEN = "token-that-nobody-else-has-0123456789"


@pytest.fixture(scope="session", autouse=True)
def _engine() -> None:
    if os.environ.get("DOPT_REQUIRE_IMAGE") != "1":
        pytest.skip("containers are run by make image (root on Debian)")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of what the services are started with, with secrets of its own."""
    root = tmp_path_factory.mktemp("checkout")
    settings = "orchestrate/executors/ray/ray.env"
    shutil.copytree(ROOT / "docker", root / "docker", ignore=shutil.ignore_patterns("secrets"))
    (root / settings).parent.mkdir(parents=True)
    shutil.copy(ROOT / settings, root / settings)
    variables = {"POSTGRES_PASSWORD": PASSWORD, "RAY_AUTH_TOKEN": TOKEN}
    Machine(root, "setup", variables=variables).run("sh", "docker/secrets.sh")
    return root


@pytest.fixture(scope="module", autouse=True)
def _cleared(_engine: None) -> Iterator[None]:
    """Leave no container, network or volume behind; the store of images is ours alone."""
    nobody = Machine(Path.cwd(), "nobody")
    yield
    nobody.run("podman", "rm", "--all", "--force", "--time", "5", check=False)
    nobody.run("podman", "pod", "rm", "--all", "--force", check=False)
    nobody.run("podman", "network", "prune", "--force", check=False)
    nobody.run("podman", "volume", "prune", "--force", check=False)
