"""A lab for each test, and the outcome of the same grid where nothing happened."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.machines.hosts import Network, unavailable
from tests.machines.lab import GRID, SEEDS, Lab, Outcome, environment
from tests.paths import ROOT

HERE = Path(__file__).parent
SECONDS = 1800
"""Above the patience of one wait, whose message says more."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.machines)
            item.add_marker(pytest.mark.timeout(SECONDS))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for reports in terminalreporter.stats.values():
        for report in reports:
            if getattr(report, "when", None) == "call":
                for what, seconds in report.user_properties:
                    terminalreporter.write_line(f"{seconds:6.1f} s  {what}")


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Callable[[str, float], None]:
    """Return a function that keeps a time for the end of the report, also from another process."""
    return record_property


@pytest.fixture(scope="session")
def namespaces() -> None:
    """Skip, or fail where that is asked for, without what the hosts are made of."""
    command = ["unshare", "--net", "--mount", "--pid", "--fork", "--uts", "--mount-proc"]
    probe = subprocess.run([*command, "ip", "link"], capture_output=True, text=True)
    reason = probe.stderr.strip() if probe.returncode else ""
    if not any(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        reason = "PostgreSQL's initdb is not installed"
    if not reason:
        return
    message = f"the hosts need root, network namespaces and PostgreSQL: {reason}"
    unavailable(message)


@pytest.fixture
def lab(namespaces: None, request: pytest.FixtureRequest) -> Iterator[Lab]:  # noqa: ARG001
    with Network(environment()) as network:
        lab = Lab(network)
        yield lab
        if request.session.testsfailed:
            for host in network.hosts.values():
                sys.stderr.write(f"--- {host.name}\n{host.logs()}\n")


@pytest.fixture(scope="session")
def undisturbed(namespaces: None, tmp_path_factory: pytest.TempPathFactory) -> Outcome:  # noqa: ARG001
    """Return the outcome of the grid, run in one process with nothing in its way."""
    url = f"sqlite:///{tmp_path_factory.mktemp('undisturbed') / 'results.db'}"
    words = [*GRID, f"seed=range({SEEDS})", "executor=inprocess", f"store.url={url}"]
    process = subprocess.run(
        [sys.executable, str(ROOT / "orchestrate/launch.py"), "-m", *words],
        capture_output=True, text=True, timeout=SECONDS, env={**os.environ, **environment()},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    text = subprocess.run(
        [sys.executable, "-m", "tests.machines.lab", url],
        capture_output=True, text=True, timeout=SECONDS, check=True, cwd=ROOT,
    ).stdout  # fmt: skip
    return Outcome.from_json(text)
