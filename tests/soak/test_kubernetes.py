"""The Job of docker/kubernetes loses nothing, though a pod is evicted every five seconds.

A stand-in for Kubernetes runs the pods of an Indexed Job as processes, by its manifest.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from tests.docker.test_files import Manifest, of_kind
from tests.paths import ROOT

ENTRY_POINT = ROOT / "docker" / "entrypoint.sh"


@dataclass
class Pod:
    """A pod of a Job: its first containers one after the other, then its only other one."""

    job: JobController
    index: int
    log: Path
    number: int = 0  # of the container that runs
    process: subprocess.Popen[bytes] = field(init=False)
    evicted: float | None = None

    def __post_init__(self) -> None:
        self._start()

    @property
    def container(self) -> str:
        return str(self.job.containers[self.number]["name"])

    @property
    def works(self) -> bool:
        """Whether the pod has come to its main container, which runs."""
        last = self.number == len(self.job.containers) - 1
        return last and self.process.poll() is None

    def evict(self) -> None:
        """Do what the eviction of a pod does to its process."""
        self.evicted = time.monotonic()
        self.process.send_signal(signal.SIGTERM)

    def exit_code(self) -> int | None:
        """Return the exit code of the pod, or None while it runs."""
        if self.evicted is not None and time.monotonic() - self.evicted > self.job.grace:
            self.process.kill()
        code = self.process.poll()
        if code == 0 and self.number < len(self.job.containers) - 1 and self.evicted is None:
            self.number += 1
            self._start()
            return None
        return code

    def _start(self) -> None:
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                ["sh", str(ENTRY_POINT), *self.job.words(self.number)],
                cwd=ROOT,
                env=self.job.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )


@dataclass
class JobController:
    """Keeps the pods of a Job running until each index has ended with success.

    Attributes
    ----------
    words_of
        Words in the place of the words of the manifest, by the name of the container.
    ended
        How often a pod ended with which exit code, evicted ones included.
    """

    manifest: Manifest
    folder: Path
    environment: Mapping[str, str]
    words_of: Mapping[str, Sequence[str]]
    ended: Counter[int] = field(default_factory=Counter)
    counted: Counter[int] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        spec = self.manifest["spec"]
        pod = spec["template"]["spec"]
        self.containers = [*pod.get("initContainers", []), *pod["containers"]]
        self.grace = float(pod["terminationGracePeriodSeconds"])
        self.limit = int(spec["backoffLimitPerIndex"])
        self.rules = spec["podFailurePolicy"]["rules"]
        self.pods = {index: self._new(index) for index in range(spec["completions"])}

    def words(self, number: int) -> Sequence[str]:
        container = self.containers[number]
        return self.words_of.get(container["name"], container["args"])

    def look(self) -> bool:
        """Replace the pods that have failed; return whether the Job goes on."""
        for index, pod in list(self.pods.items()):
            if (code := pod.exit_code()) is None:
                continue
            self.ended[code] += 1
            del self.pods[index]
            if code == 0:
                continue
            action = self._action(pod, code)
            assert action != "FailJob", f"{pod.container} ended with {code}:\n{self.logs()}"
            self.counted[index] += action == "Count"
            assert self.counted[index] <= self.limit, self.logs()
            self.pods[index] = self._new(index)
        return bool(self.pods)

    def close(self) -> None:
        """End what still runs."""
        for pod in self.pods.values():
            pod.process.kill()
            pod.process.wait()

    def logs(self) -> str:
        return "\n".join(path.read_text()[-3000:] for path in sorted(self.folder.glob("*.log")))

    def _new(self, index: int) -> Pod:
        return Pod(self, index, self.folder / f"{index}.log")

    def _action(self, pod: Pod, code: int) -> str:
        """Return what the first rule of the policy that applies says of a pod that failed."""
        for rule in self.rules:
            codes = rule.get("onExitCodes", {"containerName": None, "values": ()})
            by_code = codes["containerName"] == pod.container and code in codes["values"]
            kinds = [condition["type"] for condition in rule.get("onPodConditions", ())]
            if by_code or (pod.evicted is not None and "DisruptionTarget" in kinds):
                return str(rule["action"])
        return "Count"


def environment_of_pods(database: str) -> dict[str, str]:
    """Return the variables of the pods of these processes."""
    folder = Path(sys.executable).parent
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "DOPT_DB": database}


TRIALS = 2_000
"""Trials of the drill, unless DOPT_EVICTION_TRIALS says how many."""

SECONDS_BETWEEN_EVICTIONS = 5.0
LARGEST_SHARE_TWICE = 0.02

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


def test_evicted_pods_lose_nothing_and_compute_little_twice(
    postgresql_url: str, tmp_path: Path, tell: Callable[[str], None]
) -> None:
    trials, chance = int(os.environ.get("DOPT_EVICTION_TRIALS", TRIALS)), random.Random(3)
    grid = ("env=pendulum", "policy=d_optimal", f"seed=range({trials})")
    job = JobController(
        of_kind("workers", "Job", "dopt-workers"),
        tmp_path,
        environment_of_pods(postgresql_url),
        words_of={
            "register": ("launch", "-m", *grid, "launch.detach=true"),
            "worker": ("orchestrate", "work", "--processes=1", "--memory-gib=1.5"),
        },
    )
    evictions, due = 0, time.monotonic() + SECONDS_BETWEEN_EVICTIONS
    try:
        while job.look():
            working = [pod for pod in job.pods.values() if pod.works and pod.evicted is None]
            if working and time.monotonic() > due:
                chance.choice(working).evict()
                evictions, due = evictions + 1, time.monotonic() + SECONDS_BETWEEN_EVICTIONS
            time.sleep(0.1)
    finally:
        job.close()
    statuses, attempts, in_vain = outcomes(postgresql_url)
    tell(
        f"{trials:,} trials, {evictions} evictions, pods ended with {dict(job.ended)}, "
        f"attempts {attempts}, at most {in_vain} of them begun in vain"
    )
    assert evictions >= trials / 200
    assert statuses == {"done": trials}
    assert attempts["done"] == trials
    assert attempts.keys() <= {"done", "released", "lost"}
    assert in_vain + attempts.get("lost", 0) <= LARGEST_SHARE_TWICE * trials


def outcomes(url: str) -> tuple[dict[str, int], dict[str, int], int]:
    """Return the trials by status, the attempts by outcome, and how many were begun in vain.

    These are at most the first trials of the workers, which load the compiled code: a worker that
    is warned finishes a later one, which takes less than a tenth of a second, and hands back trials
    that have not begun. It runs one at a time.
    """
    engine = create_engine(url)
    with engine.connect() as connection:

        def table(query: str) -> dict[str, int]:
            return {str(key): int(n) for key, n in connection.execute(text(query))}

        statuses = table("SELECT status, count(*) FROM trial GROUP BY 1")
        attempts = table("SELECT outcome, count(*) FROM attempt GROUP BY 1")
        workers = (
            "SELECT launch_id, count(*) FILTER (WHERE outcome = 'done') FROM attempt "
            "GROUP BY launch_id HAVING count(*) FILTER (WHERE outcome = 'released') > 0"
        )
        in_vain = sum(done == 0 for done in table(workers).values())
    engine.dispose()
    return statuses, attempts, in_vain
