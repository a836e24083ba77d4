"""Launches on a Ray cluster on this machine, each with a fault: ``python -m ... FOLDER``.

To be run in a network namespace of its own, whose loopback has the addresses. Each launch writes
to a database of its own in FOLDER, and ``report.json`` there says how it ended.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray.cluster_utils import Cluster

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import InfrastructureError
from orchestrate.executors.base import Run
from orchestrate.runner.start import Work, launch_grid
from orchestrate.store import LaunchRecord
from tests.orchestrate.standins import quick, specification
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

RECORD = LaunchRecord(argv=["launch"], overrides=[], host="here", pid=1)
ADDRESSES = [f"10.77.1.{number}" for number in range(1, 17)]
SEEDS = 40
LONG_SEED = 3
LOSSES = 2
NEW_CORES = 2
CORES = 1 + NEW_CORES
"""More than the chunks that are handed out ahead to one node of one core."""


class Notes:
    """Files that say which node did what: all nodes here have the name of the one machine."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, kind: str) -> None:
        node = ray.get_runtime_context().get_node_id()
        (self._folder / f"{kind} {node} {time.time_ns()} {os.getpid()}").touch()

    def nodes(self, kind: str) -> list[str]:
        """Return the node of each note, the latest last."""
        names = (path.name.split() for path in self._folder.glob(f"{kind} *"))
        return [node for _, node, _, _ in sorted(names, key=lambda name: int(name[2]))]

    def workers(self, kind: str) -> set[str]:
        """Return the processes that have left a note."""
        return {path.name.split()[3] for path in self._folder.glob(f"{kind} *")}


def tenth_of_a_second(notes: Notes, spec: TrialSpec) -> TrialResult:
    time.sleep(0.1)
    notes.add("headless")
    return quick(spec)


def until_many_work(notes: Notes, spec: TrialSpec) -> TrialResult:
    """Wait for as many workers as there are cores, with a node that comes later."""
    notes.add("working")
    until(lambda: len(notes.workers("working")) >= CORES)
    return quick(spec)


def one_takes_long(notes: Notes, spec: TrialSpec) -> TrialResult:
    """Take long for one trial, until its node was lost often enough."""
    if spec.seed == LONG_SEED:
        notes.add("long")
        if len(notes.nodes("long")) <= LOSSES:
            time.sleep(PATIENCE_SECONDS)
    return quick(spec)


class Nodes:
    """The nodes of the cluster, by their identity."""

    def __init__(self) -> None:
        self._cluster = Cluster(shutdown_at_exit=False)  # its signals are not for threads
        self._addresses = iter(ADDRESSES)
        self.head = self._add(
            num_cpus=0, include_dashboard=False, include_log_monitor=False, no_monitor=True
        )
        self.address = self._cluster.address
        self._nodes: dict[str, Any] = {}

    def add(self, cores: int = 1, **environment: str) -> str:
        node = self._add(num_cpus=cores, env_vars=environment)
        self._nodes[node.node_id] = node
        return str(node.node_id)

    def remove(self, node: str) -> None:
        """End a node as ``kill -9`` of all its processes does."""
        self._cluster.remove_node(self._nodes.pop(node), allow_graceful=False)

    def remove_all(self) -> None:
        for node in list(self._nodes):
            self.remove(node)

    def _add(self, **options: Any) -> Any:
        address = next(self._addresses)
        return self._cluster.add_node(
            node_ip_address=address, object_store_memory=80_000_000, **options
        )


class Launches:
    """Launches of one grid into databases of their own, with a fault in mid-run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notes = Notes(folder)
        self.nodes = Nodes()
        self.report: dict[str, Any] = {}

    def __call__(self, name: str, run: Run, fault: Callable[[], None] = lambda: None) -> None:
        """Launch, and report the exit code and the error."""
        trials = [specification(seed) for seed in range(SEEDS)]
        grid = Grid(trials, n_jobs=SEEDS, left_out={})
        settings = LaunchSettings(
            executor="ray",
            store_url=f"sqlite:///{self.folder / name}.db",
            ray_address=self.nodes.address,
            chunk_seconds=0.5,
        )
        work = Work(run, partial(self._prepare, self.notes, name))
        code, error = 75, ""
        with ThreadPoolExecutor() as threads:
            injected = threads.submit(fault)
            try:
                code = int(launch_grid(grid, settings, RECORD, work, print, stream=None))
            except InfrastructureError as caught:
                error = str(caught)
            injected.result()
        self.report[name] = {"code": code, "error": error}

    @staticmethod
    def _prepare(notes: Notes, name: str, _: object) -> AbstractContextManager[None]:
        if ray.is_initialized():
            notes.add(f"prepared-{name}")
        return nullcontext()


def run_all(folder: Path) -> None:
    """Launch on two nodes, of which one comes later, and then with each fault."""
    launch = Launches(folder)
    nodes, notes = launch.nodes, launch.notes
    first = nodes.add()
    both = {first}

    def add_node() -> None:
        until(lambda: notes.nodes("working"))
        both.add(nodes.add(NEW_CORES))

    launch("added", partial(until_many_work, notes), add_node)
    launch.report["added"]["both nodes"] = set(notes.nodes("working")) == both
    launch.report["added"]["prepared"] = set(notes.nodes("prepared-added")) == both

    def lose_nodes() -> None:
        for number in range(1, LOSSES + 1):
            until(lambda: len(notes.nodes("long")) == number)  # noqa: B023  # called at once
            if number == 1:
                nodes.add()
            nodes.remove(notes.nodes("long")[-1])

    launch("lost", partial(one_takes_long, notes), lose_nodes)

    def kill_head() -> None:
        until(lambda: notes.nodes("headless"))
        nodes.head.kill_gcs_server()

    nodes.remove_all()
    nodes.add(PYTHONPATH=str(other_code(launch.folder)))
    launch("other_code", quick)
    nodes.remove_all()
    nodes.add()
    launch("headless", partial(tenth_of_a_second, notes), kill_head)
    (folder / "report.json").write_text(json.dumps(launch.report))


def other_code(folder: Path) -> Path:
    """Return a folder with a copy of the code that differs by a comment."""
    for package in ("dopt", "orchestrate", "tests"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, folder / "other" / package, symlinks=True, ignore=ignore)
    with (folder / "other/dopt/result.py").open("a") as source:
        source.write("# other\n")
    return folder / "other"


if __name__ == "__main__":
    run_all(Path(sys.argv[1]))
    os._exit(0)  # what is left ends with the namespaces; Ray would take seconds
