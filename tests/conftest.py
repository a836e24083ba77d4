"""One core for every numeric library, before any of them is imported; the same examples always.

Here too: one database for each test, of each kind.
"""

from __future__ import annotations

import gc
import os
import sys

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

# The collector of garbage runs less often than it does by itself: 5 % of the time of the suite, and
# a fifth of the time in which the tests are collected.
gc.set_threshold(100_000, 20, 50)

# Otherwise pytest rewrites every test again, and each process that a test starts compiles the
# sources of its libraries, for seconds.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import shutil  # noqa: E402  all of these after the threads are set
import signal  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402
from sqlalchemy import Engine, create_engine  # noqa: E402
from sqlalchemy.exc import OperationalError  # noqa: E402

# As from a terminal: a shell starts what runs in its background with Ctrl-C ignored, and programs
# that the tests start and interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "suite",
    max_examples=50,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("suite")

RUNNING_SERVER = "postgresql+psycopg://postgres@127.0.0.1:5432/postgres"
"""Server that is asked where none is named, and none can be started."""

MEMORY = Path("/dev/shm")
MEMORY_BYTES = 2 * 2**30

# No test cuts the power: none needs what the disk, and not the kernel, holds of a database, and
# SQLite waits for the disk at every commit.
if os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MEMORY_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))


BEGAN = time.monotonic()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Print what the run took; its CPU seconds include all processes that it has waited for."""
    if not hasattr(config, "workerinput"):
        cpu, wall = sum(os.times()[:4]), time.monotonic() - BEGAN
        print(f"{cpu:.0f} CPU seconds, {wall:.0f} s, load {os.getloadavg()[0]:.1f}")  # noqa: T201


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start first what one worker runs for minutes, so that none is left alone at the end.

    That is what is marked as long, then every group that has to stay in one worker.
    """
    items.sort(
        key=lambda item: (
            item.get_closest_marker("long") is None,
            item.get_closest_marker("xdist_group") is None,
        )
    )


def pytest_collection_finish() -> None:
    """Let the collector of garbage pass over the modules and tests, which stay to the end."""
    gc.freeze()


@pytest.fixture
def sqlite_url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/results/results.db"


@pytest.fixture(scope="session")
def server_url() -> Iterator[str]:
    """URL of the server that is named, or of one of our own, which does not wait for the disk."""
    from tests.orchestrate.faults.laboratory import Server, binaries

    named = os.environ.get("DOPT_TEST_POSTGRES")
    try:
        binaries()
    except FileNotFoundError:
        named = named or RUNNING_SERVER
    if named:
        yield named
        return
    server = Server()
    yield server.url
    server.remove()


@pytest.fixture(scope="session")
def server(server_url: str) -> Iterator[Engine]:
    engine = create_engine(server_url, connect_args={"connect_timeout": 3})
    try:
        engine.connect().close()
    except OperationalError as error:
        reason = str(error.orig).splitlines()[0]
        message = f"no PostgreSQL server answers, set DOPT_TEST_POSTGRES to one: {reason}"
        if os.environ.get("DOPT_REQUIRE_POSTGRES") == "1":
            pytest.fail(message)
        pytest.skip(message)
    yield engine
    engine.dispose()


@pytest.fixture
def postgresql_url(request: pytest.FixtureRequest) -> Iterator[str]:
    """URL of a new schema on the server, dropped afterwards."""
    from tests.orchestrate.store.databases import new_schema

    with new_schema(request) as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    return str(request.getfixturevalue(f"{request.param}_url"))
