"""Settings of a process: its cores, locks of files, garbage, and Ctrl-C while it starts.

The cores follow its affinity, and the quotas of its control groups. Garbage is collected rarely:
Python searches for unreachable cycles after every 700 new containers. A program that imports large
libraries and compiles makes very many that stay until its end, and spent a sixth of a short run on
such searches.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

fcntl: Any = None  # which Windows lacks; a program of one process does without locks
with suppress(ModuleNotFoundError):
    import fcntl

PROC = Path("/proc/self")


def usable_cores() -> int:
    """Return the number of cores that this process can keep busy, at least 1.

    Quotas of control groups count (``docker --cpus``, limits of Kubernetes, ``CPUQuota`` of
    systemd), versions 1 and 2, including the groups around this process's group. A part of a
    core counts for nothing.
    """
    known = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1
    return max(1, int(min([cores, *_quotas()])))


def lock_file(file: int, *, wait: bool = True) -> bool:
    """Lock an open file until it is closed, and return whether no other process holds it.

    Where the system has no such locks nothing is locked, and True is returned.

    Raises
    ------
    OSError
        If its file system has no locks.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True


def lock_stream(stream: Any, *, release: bool) -> bool:
    """Lock what a stream writes to, at once, and return whether no other process holds it.

    Raises
    ------
    OSError, TypeError, ValueError
        If it is no file.
    """
    if fcntl is None:
        return True
    try:
        fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    if release:
        fcntl.lockf(stream, fcntl.LOCK_UN)
    return True


def _quotas() -> Iterator[float]:
    """Yield the quota in cores of every control group that this process is in."""
    for folder in _groups():
        with suppress(OSError, ValueError, ZeroDivisionError):  # "max", or -1, without a quota
            quota, period = map(int, (folder / "cpu.max").read_text().split())
            yield quota / period
        with suppress(OSError, ValueError, ZeroDivisionError):
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            quota, period = (int((folder / name).read_text()) for name in names)
            if quota > 0:
                yield quota / period


def _groups() -> Iterator[Path]:
    """Yield the folders of the control groups of this process that may limit its cores.

    A container may see a part of the hierarchy: what is mounted begins at a group of its own.
    """
    with suppress(OSError, ValueError):
        lines = [line.split(":", 2) for line in (PROC / "cgroup").read_text().splitlines()]
        paths = {kind: path for _, kinds, path in lines for kind in kinds.split(",")}
        for line in (PROC / "mountinfo").read_text().splitlines():
            mount, _, system = line.partition(" - ")
            root, point = mount.split()[3:5]
            kind, _, options = system.split(maxsplit=2)
            name = {"cgroup2": "", "cgroup": "cpu"}.get(kind)
            if name not in paths or (name and name not in options.split(",")):
                continue
            below = Path(paths[name].removeprefix(root).lstrip("/"))
            yield from (Path(point) / folder for folder in (below, *below.parents))


NEW_CONTAINERS = 100_000
"""Containers that are made between two searches."""


def collect_rarely() -> None:
    """Make this process search for unreachable cycles less often.

    For programs, early, as imports gain most; a library leaves the setting to its user.
    """
    gc.set_threshold(NEW_CONTAINERS)


def _end(*_: object) -> None:
    os._exit(130)  # ExitCode.INTERRUPTED, whose module loads more


def end_at_interrupt() -> None:
    """Let Ctrl-C end this process without a traceback, unless it is ignored or handled.

    For programs, before their imports: some libraries make another error of a
    ``KeyboardInterrupt`` while they are imported, as Hydra does while it composes.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_at_interrupt() -> None:
    """Let Ctrl-C raise ``KeyboardInterrupt`` again: from here on something has to be closed."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
