"""Measurement of commands as whole processes, launches in this process, and stand-in records."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from dopt.kernel import compiling
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.runner.start import Output, Work, launch_grid
from orchestrate.store import Claim, LaunchRecord, Reader, RunRecord, Store

ROOT = Path(__file__).resolve().parents[1]
POLL_SECONDS = 0.02
LAUNCH = str(ROOT / "orchestrate" / "launch.py")


@dataclass(frozen=True)
class Finished:
    """A process that ended well.

    Attributes
    ----------
    started
        Seconds since 1970 at which it was started.
    seconds, cpu_seconds
        Until its end; of the processor, its children included.
    peak_mebibytes
        Largest resident memory of the process itself, without its children (Linux; else NaN).
    output
        Its output.
    """

    started: float
    seconds: float
    cpu_seconds: float
    peak_mebibytes: float
    output: str


def run(*arguments: str) -> Finished:
    """Run this interpreter with arguments and return what it took.

    Raises
    ------
    RuntimeError
        If the process fails; the message holds the end of its output.
    """
    with tempfile.TemporaryFile("w+") as output:
        started, clock, cpu = time.time(), time.perf_counter(), _children_cpu_seconds()
        process = subprocess.Popen(
            [sys.executable, *arguments], stdout=output, stderr=subprocess.STDOUT, cwd=ROOT
        )
        peak = float("nan")
        while process.poll() is None:
            peak = peak_mebibytes(process.pid, peak)
            time.sleep(POLL_SECONDS)
        seconds = time.perf_counter() - clock
        output.seek(0)
        text = output.read()
    if process.returncode:
        raise RuntimeError(
            f"'{' '.join(arguments)}' ended with {process.returncode}, but 0 is expected; its last "
            f"line is: {text.strip().splitlines()[-1:]}"
        )
    return Finished(started, seconds, _children_cpu_seconds() - cpu, peak, text)


def _children_cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def peak_mebibytes(pid: int, before: float) -> float:
    """Return the largest resident memory so far, or ``before`` once the process has ended.

    The kernel's account at the end (``ru_maxrss``) holds the memory of the process that started it.
    """
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return before
    lines = [line for line in status.splitlines() if line.startswith("VmHWM")]
    return int(lines[0].split()[1]) / 1024 if lines else before


def launch(*arguments: str) -> Finished:
    """Run ``orchestrate/launch.py``."""
    return run(LAUNCH, *arguments)


def database(folder: str | Path, name: str = "results") -> str:
    """Return the URL of a database in a folder."""
    return f"sqlite:///{Path(folder) / name}.db"


RECORD = LaunchRecord(argv=["benchmarks"], overrides=[], host="benchmark", pid=1)


@dataclass(frozen=True)
class Accounts:
    """What the trials of a launch took.

    Attributes
    ----------
    span
        Seconds from the start of the first trial to the end of the last one.
    work
        Sum of the seconds that the trials took themselves.
    rate
        Trials per second once every worker has ended its first one, which loads compiled code.
    """

    span: float
    work: float
    rate: float


def launch_trials(url: str, specs: Sequence[TrialSpec], workers: int) -> Accounts:
    """Run the trials of one configuration on the local executor."""
    settings = LaunchSettings(executor="local", store_url=url, workers=workers)
    grid = Grid(list(specs), n_jobs=len(specs), left_out={})
    work = Work(run_trial, compiling)
    code = launch_grid(grid, settings, RECORD, work, Output(_nothing, _nothing))
    if code is not ExitCode.DONE:
        raise RuntimeError(f"the launch ended with {code!r}, but {ExitCode.DONE!r} is expected.")
    with Reader.open(url) as reader:
        rows = reader.rows("SELECT pid, started, ended, wall_seconds FROM attempt")
    return _accounts(
        [(pid, _since_1970(start), _since_1970(end), work) for pid, start, end, work in rows]
    )


def _accounts(rows: Sequence[tuple[int, float, float, float]]) -> Accounts:
    """Return the accounts of trials, each with its process, start, end and own seconds."""
    first_ends: dict[int, float] = {}
    for pid, _, end, _ in rows:
        first_ends[pid] = min(end, first_ends.get(pid, end))
    steady, last = max(first_ends.values()), max(end for _, _, end, _ in rows)
    later = sum(end > steady for _, _, end, _ in rows)
    span = last - min(start for _, start, _, _ in rows)
    return Accounts(span, sum(work for *_, work in rows), later / (last - steady))


def _since_1970(stamp: str) -> float:
    return datetime.fromisoformat(stamp).timestamp()


def _nothing(_: str) -> None:
    """Say nothing."""


def run_record() -> RunRecord:
    """Return the record of a run that took no time."""
    now = datetime.now(UTC)
    return RunRecord("benchmark", 1, 0.0, 0.0, 0, now, now)


def claims_for(store: Store, launch: int, specs: Sequence[TrialSpec]) -> list[Claim]:
    """Register trials and claim all of them."""
    return store.claim(launch, store.register(launch, specs).todo)
