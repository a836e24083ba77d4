"""History of the benchmarks: a line of JSON a run, and which of its rows have become slower."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median

from benchmarks.processes import ROOT
from benchmarks.rows import TIMES, Row, Timing
from dopt.process import usable_cores

FEWEST = 3
"""Runs of a row before its median says anything."""

SLOWER, SLOWER_ELSEWHERE = 1.2, 2.0
"""Times the median at which a row counts as slower: on the same processor, where the medians of
runs on an idle and on a busy machine differ by a few per cent; beside other processors, where rows
took up to 1.8 times as long beside the calibration."""


@dataclass(frozen=True)
class Run:
    """Rows of one run of the benchmarks, by question and what was measured.

    ``processor`` is empty where it is not known.
    """

    date: str
    commit: str
    machine: str
    processor: str = ""
    rows: dict[str, Timing] = field(default_factory=dict)

    @classmethod
    def now(cls) -> Run:
        """Return a run that has no rows yet."""
        date = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(date, _commit(), " ".join(describe()), processor())

    def add(self, question: str, rows: Sequence[Row], calibration: float) -> None:
        """Take in the rows of a question that are times or rates; of two, the cheaper one stays."""
        for row in rows:
            if row.value and (row.unit in TIMES or row.unit.endswith("/s")):
                timing = row.timing or Timing(row.value, row.unit, calibration)
                name = f"{question}: {row.what}"
                self.rows[name] = min(timing, self.rows.get(name, timing), key=lambda one: one.cost)


@dataclass(frozen=True)
class Slower:
    """A row that takes longer than it did."""

    name: str
    times: float
    runs: int
    elsewhere: bool

    @property
    def question(self) -> str:
        return self.name.partition(": ")[0]

    def __str__(self) -> str:
        where = " on all processors" if self.elsewhere else ""
        return f"{self.name}: {self.times:.2f} times the median of {self.runs} runs{where}"


def append(path: Path, run: Run) -> None:
    """Add a run to a file, which is made if it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(asdict(run), ensure_ascii=False)}\n")


def read(path: Path) -> list[Run]:
    """Return the runs of a file, the oldest first.

    Raises
    ------
    ValueError
        If a line is no run.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    return [_run(path, number, line) for number, line in enumerate(lines, start=1)]


def costs(runs: Sequence[Run]) -> Mapping[str, list[float]]:
    """Return the costs of each row in the runs that have it."""
    found: dict[str, list[float]] = {}
    for run in runs:
        for name, timing in run.rows.items():
            found.setdefault(name, []).append(timing.cost)
    return found


def slower(runs: Sequence[Run], run: Run) -> list[Slower]:
    """Return the rows of a run that take so many times the median of earlier ones, or longer.

    A row is compared with runs on the same kind of processor, or with all where these are too few.
    """
    here = costs([past for past in runs if past.processor == run.processor])
    anywhere, found = costs(runs), []
    for name, timing in run.rows.items():
        elsewhere = len(here.get(name, ())) < FEWEST
        past = (anywhere if elsewhere else here).get(name, ())
        if len(past) < FEWEST:
            continue
        row = Slower(name, timing.cost / median(past), len(past), elsewhere)
        if row.times >= (SLOWER_ELSEWHERE if elsewhere else SLOWER):
            found.append(row)
    return found


def _run(path: Path, number: int, line: str) -> Run:
    try:
        stored = json.loads(line)
        rows = {name: Timing(**timing) for name, timing in stored.pop("rows").items()}
        return Run(**stored, rows=rows)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"line {number} of {path} is no run of the benchmarks ({error!r}): remove it, or give "
            f"another file."
        ) from error


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


LIBRARIES = ("numpy", "numba", "llvmlite", "torch", "jax", "ray", "sqlalchemy", "matplotlib")


def describe() -> list[str]:
    """Return lines about the processor, its load, and the versions of the libraries."""
    cores = usable_cores()
    load = os.getloadavg()[0]
    found = [f"{name} {version(name)}" for name in LIBRARIES if find_spec(name)]
    return [
        f"machine: {processor()}, {cores} cores, {platform.system()} {platform.release()}, "
        f"load {load:.1f} before the start",
        f"versions: Python {platform.python_version()}, {', '.join(found)}",
    ]


def processor() -> str:
    """Return the name of the processor as the kernel knows it, with its generation."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    pairs = [line.partition(":") for line in lines]
    known = {key.strip(): value.strip() for key, _, value in reversed(pairs)}
    if "model name" not in known:
        return platform.machine()
    family, model = known.get("cpu family", "?"), known.get("model", "?")
    return f"{known['model name']} (family {family}, model {model})"
