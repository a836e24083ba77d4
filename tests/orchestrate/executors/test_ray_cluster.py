"""Launches on a Ray cluster that loses nodes, gets new ones, and loses its head.

The cluster is one of this machine's own processes, in a network namespace of its own; hosts that
are apart are tested in ``tests/machines``.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.ray.connection import SETTINGS_FILE, first_line
from orchestrate.executors.ray.executor import RayExecutor
from orchestrate.store import Reader
from tests.orchestrate.clustered_launches import ADDRESSES, LONG_SEED, LOSSES, ROOT
from tests.orchestrate.conftest import Launches
from tests.orchestrate.standins import quick

pytestmark = pytest.mark.xdist_group("ray")

NAMESPACES = ["--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
SCRIPT = """
ip link set lo up
for address in $ADDRESSES; do ip address add "$address/32" dev lo; done
mkdir -p /tmp/ray
mount -t tmpfs ray /tmp/ray
exec "$@"
"""


class Outcome:
    """What the launches reported, and their databases."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.report: dict[str, dict[str, Any]] = json.loads((folder / "report.json").read_text())

    def query(self, name: str, sql: str) -> list[tuple[Any, ...]]:
        with Reader.open(f"sqlite:///{self._folder / name}.db") as reader:
            return [tuple(row) for row in reader.rows(sql)]

    def curves(self, name: str) -> list[tuple[Any, ...]]:
        return self.query(name, CURVES)


CURVES = "SELECT seed, t, loss, reachable_loss FROM v_curve ORDER BY seed, t"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """Start a cluster in namespaces of its own and run every launch on it."""
    _need_namespaces()
    folder = tmp_path_factory.mktemp("cluster")
    settings = dict(
        line.split("=") for line in SETTINGS_FILE.read_text().splitlines() if line[:4] == "RAY_"
    )
    # Not from the folder of the code, which Ray would offer to the nodes.
    process = subprocess.run(
        ["setpriv", "--pdeathsig", "KILL", "unshare", *NAMESPACES, "--", "sh", "-ec", SCRIPT, "sh",
         sys.executable, "-m", "tests.orchestrate.clustered_launches", str(folder)],
        cwd=folder, capture_output=True, text=True,
        env={**os.environ, **settings, "ADDRESSES": " ".join(ADDRESSES), "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return Outcome(folder)


@pytest.fixture
def undisturbed(launches: Launches) -> list[tuple[Any, ...]]:
    launches(seeds=40)
    return launches.query(CURVES)


def _need_namespaces() -> None:
    probe = subprocess.run(["unshare", *NAMESPACES, "true"], capture_output=True, text=True)
    if probe.returncode == 0:
        return
    message = f"needs root and network namespaces: {probe.stderr.strip()}"
    if os.environ.get("DOPT_REQUIRE_MACHINES") == "1":
        pytest.fail(message)
    pytest.skip(message)


def test_all_nodes_are_prepared_and_used(
    outcome: Outcome, undisturbed: list[tuple[Any, ...]]
) -> None:
    assert outcome.report["plain"].items() >= {
        "code": 0, "both nodes": True, "prepared": True,
    }.items()  # fmt: skip
    assert outcome.curves("plain") == undisturbed
    assert outcome.query("plain", "SELECT max(attempt) FROM trial") == [(1,)]


def test_a_lost_node_costs_its_trials_nothing(
    outcome: Outcome, undisturbed: list[tuple[Any, ...]]
) -> None:
    """A trial that had killed its worker as often would have failed."""
    assert outcome.report["lost"]["code"] == 0, outcome.report["lost"]
    assert outcome.curves("lost") == undisturbed
    sql = f"SELECT status, attempt FROM trial WHERE seed = {LONG_SEED}"
    assert outcome.query("lost", sql) == [("done", LOSSES + 1)]
    assert outcome.query("lost", "SELECT DISTINCT outcome, cause FROM attempt ORDER BY 1") == [
        ("done", None), ("released", "node lost"),
    ]  # fmt: skip


def test_a_node_that_joins_later_gets_its_share(
    outcome: Outcome, undisturbed: list[tuple[Any, ...]]
) -> None:
    assert outcome.report["added"]["code"] == 0, outcome.report["added"]
    assert outcome.curves("added") == undisturbed
    assert outcome.query("added", "SELECT max(attempt) FROM trial") == [(1,)]


@pytest.mark.parametrize(
    ("name", "difference"),
    [
        ("other_code", "the code of dopt is"),
        ("other_settings", "period_ms is 2000, here it is 1000"),
    ],
)
def test_a_node_that_is_not_alike_is_refused_before_it_computes_anything(
    outcome: Outcome, name: str, difference: str
) -> None:
    assert outcome.report[name]["code"] == 75
    assert difference in outcome.report[name]["error"]
    assert outcome.query(name, "SELECT DISTINCT status FROM trial") == [("pending",)]


def test_the_loss_of_the_head_ends_the_launch_and_frees_its_claims(outcome: Outcome) -> None:
    assert outcome.report["headless"]["code"] == 75
    assert "has not answered for 3 s" in outcome.report["headless"]["error"]
    assert outcome.query("headless", "SELECT count(*) FROM trial WHERE status = 'running'") == [
        (0,)
    ]
    assert outcome.query("headless", "SELECT state FROM launch") == [("failed",)]


@pytest.mark.parametrize("address", ["ray://10.0.0.1:10001", "head", "me:secret@head:6379"])
def test_an_address_of_another_kind_is_a_wrong_setting(address: str) -> None:
    with pytest.raises(LaunchError, match="HOST:PORT of the head"):
        RayExecutor(quick, address=address)


def test_that_nothing_answers_at_an_address_is_said_at_once() -> None:
    """Ray itself was seen to try for more than two minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    executor = RayExecutor(quick, address=f"127.0.0.1:{port}")
    with pytest.raises(InfrastructureError, match=f"reached at '127.0.0.1:{port}'.*refused"):
        executor.start()


def test_a_token_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_TOKEN", "abc123")
    assert first_line(ValueError("wrong token abc123\nmore")) == "wrong token ***"
