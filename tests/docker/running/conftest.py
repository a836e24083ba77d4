"""Runs only where ``make image`` has built the images and made a place for containers."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docker.running.engine import Machine
from tests.paths import ROOT

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
