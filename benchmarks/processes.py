"""Measurement of commands as whole processes: time and memory."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

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
            peak = _peak_mebibytes(process.pid, peak)
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


def _peak_mebibytes(pid: int, before: float) -> float:
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
