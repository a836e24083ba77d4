"""Grids of the states that a page must show, in a database of either kind, and the SQL form."""

from __future__ import annotations

import re
import sys
from datetime import UTC, datetime
from pathlib import Path

from httpx import Response
from starlette.testclient import TestClient

from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.runner.start import Output, Work, launch_grid
from orchestrate.store import Failure, LaunchRecord, RunRecord, Store
from tests.analysis.synthetic import fake_result, fill, make_grid
from tests.orchestrate.faults.trials import Gate, Gated

SHORT = {"env": {"horizon": 40}}
TRACEBACK = "Traceback (most recent call last):\n  <script>alert('no')</script>\nValueError: no"
FAILURE = Failure("ValueError", "the <b>input</b> is wrong", TRACEBACK)
NOW = datetime(2026, 1, 1, tzinfo=UTC)
RUN = RunRecord("node-1", 7, 1.5, 1.25, 2**28, NOW, NOW)


def mixed(url: str) -> None:
    """Fill a database with two systems, five policies, two widths and trials of every status."""
    specs = make_grid(("pendulum", "cartpole"), seeds=range(4), **SHORT)
    specs += make_grid(
        ("pendulum",), ("d_optimal", "random"), range(4), model={"width": 4}, **SHORT
    )
    left = [spec for spec in specs if spec.policy.name == "periodic" and spec.seed > 1]
    [lost] = [
        s for s in specs if (s.system.name, s.policy.name, s.seed) == ("cartpole", "random", 2)
    ]
    fill(url, specs, skipped=left, diverged={lost.trial_key: 17})
    with Store.open(url) as store:
        launch = begin(store)
        (claim,) = store.claim(launch, [left[0].trial_key])
        assert store.fail(claim, FAILURE, RUN)
        store.end_launch(launch, "done")


def variants(url: str) -> None:
    """Fill a database with configurations that share environment, policy and width, and a task."""
    task = {"task": {"name": "control", "checkpoints": [10, 20]}}
    replay = {"learner": {"name": "adam_replay"}}
    features = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
    one = ("pendulum",)
    specs = make_grid(one, ("d_optimal", "random"), range(3), **SHORT)
    specs += make_grid(one, ("d_optimal", "random"), range(3), env={"horizon": 40, "gamma": 3.0})
    specs += make_grid(one, ("d_optimal",), range(3), **SHORT, **replay)
    specs += make_grid(one, ("d_optimal",), range(3), **SHORT, **features)
    specs += make_grid(
        ("pendulum", "quadrotor"), ("d_optimal", "random"), range(3), **SHORT, **task
    )
    fill(url, specs)


def finish(store: Store, launch: int, spec: TrialSpec) -> None:
    """Claim a trial and commit a made-up result of it."""
    (claim,) = store.claim(launch, [spec.trial_key])
    assert store.commit(claim, fake_result(spec), RUN)


def begin(store: Store) -> int:
    """Begin a launch of this process."""
    return store.begin_launch(LaunchRecord(argv=["test"], overrides=[], host="here", pid=1))


def nothing(url: str) -> None:
    """Make a database without trials."""
    Store.open(url).close()


def one_trial(url: str) -> None:
    """Make a database with one finished trial."""
    fill(url, make_grid(("pendulum",), ("d_optimal",), range(1), **SHORT))


def with_limits(url: str) -> None:
    """Make a database of two trials in the cartpole on a rail, the second of which diverged."""
    limits = {"bounds": {"y": [-0.1, 0.1], "φ̇": [None, 9.0]}, "enforced": False}
    specs = make_grid(("cartpole",), ("d_optimal",), range(2), limits=limits, **SHORT)
    fill(url, specs, diverged={specs[1].trial_key: 17})


def all_diverged(url: str) -> None:
    """Make a database of which every trial diverged, one of them at once."""
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(3), **SHORT)
    fill(url, specs, diverged={spec.trial_key: 5 * spec.seed for spec in specs})


def token(client: TestClient) -> str:
    """Return the token of the form."""
    found = re.search(r'name="token" value="([\w-]+)"', client.get("/sql").text)
    assert found
    return found[1]


def post(client: TestClient, path: str, statement: str, **headers: str) -> Response:
    """Send a statement, with headers whose names have underscores for dashes."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return client.post(path, data={"q": statement, "token": token(client)}, headers=named)


def launch(url: str, seeds: int, folder: Path) -> int:
    """Launch pendulum trials of two policies that pass a gate: ``-m ... URL SEEDS FOLDER``."""
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(seeds), **SHORT)
    settings = LaunchSettings(executor="inprocess", store_url=url, workers=1)
    record = LaunchRecord(argv=["launch"], overrides=[], host="here", pid=1)
    work = Work(Gated(fake_result, Gate(folder)))
    grid = Grid(specs, n_jobs=len(specs), left_out={})
    return int(launch_grid(grid, settings, record, work, Output(print, print)))


if __name__ == "__main__":
    sys.exit(launch(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])))
