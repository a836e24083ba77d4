"""Saves of an exploration that grows into the results database."""

from __future__ import annotations

import logging
import os
import resource
import socket
import sys
import threading
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dopt.result import TrialResult
from orchestrate.executors.task import BYTES_PER_KIB
from orchestrate.runner.heartbeat import Heartbeat
from orchestrate.runner.provenance import launch_record
from orchestrate.store import (
    LEASE_SECONDS,
    DatabaseMovedError,
    Registrable,
    RunRecord,
    Saved,
    Store,
    StoreError,
    default_url,
)

ROOT = Path(__file__).resolve().parents[2]

_log = logging.getLogger("dopt.explorer")


class ExplorationSaver:
    """Launch that one process saves one exploration in; any thread may save.

    Parameters
    ----------
    url : str or None
        Database, by default that of a launch (:func:`orchestrate.store.default_url`); it is made
        if there is none.

    Raises
    ------
    StoreError
        If the URL names no database that can be written.
    """

    def __init__(self, url: str | None) -> None:
        self._record = launch_record(sys.argv, [], ROOT)
        self._url = default_url() if url is None else str(url)
        self._store: Store | None = _opened(self._url)
        self._lock = threading.Lock()
        self._launch: int | None = None
        self._alive = ExitStack()
        self._last: Saved | None = None

    def save(self, spec: Registrable, result: TrialResult) -> bool:
        """Write an exploration; return False if the database holds more steps of it.

        Raises
        ------
        StoreError
            If nothing was written: the database fails, or holds another exploration. If its file
            was removed, renamed or replaced, the next save opens the URL anew.
        """
        with self._lock:
            self._store = self._store or _opened(self._url)
            try:
                return self._save(self._store, spec, result)
            except DatabaseMovedError:
                self._end()
                raise

    def _save(self, store: Store, spec: Registrable, result: TrialResult) -> bool:
        if self._launch is None:
            if store.holds_more(spec, result):
                return False
            self._launch = store.begin_launch(self._record)
            self._alive.enter_context(Heartbeat(store, self._launch, LEASE_SECONDS))
        last, self._last = self._last, None  # whether a save that fails has written is unknown
        self._last = store.save(self._launch, spec, result, _run_record(result), last)
        return self._last is not None

    def close(self) -> None:
        """End the launch and close the database."""
        if os.getpid() != self._record.pid:
            return  # a process that was forked, whose parent goes on
        with self._lock:
            self._end()

    def _end(self) -> None:
        store, launch = self._store, self._launch
        self._store = self._launch = self._last = None
        self._alive.close()
        if store is None:
            return
        try:
            if launch is not None:
                store.end_launch(launch, "done", 0)
        except DatabaseMovedError:
            pass  # the save has said so
        except (StoreError, ValueError) as error:  # the latter if its row was deleted
            _log.warning("the launch of the saves could not be ended: %s", error)
        finally:
            store.close()


def _opened(url: str) -> Store:
    store = Store.open(url, LEASE_SECONDS)
    try:
        store.recover()  # marks the launch of a process that was killed as lost
    except StoreError:
        store.close()
        raise
    return store


def _run_record(result: TrialResult) -> RunRecord:
    now = datetime.now(UTC)
    return RunRecord(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=result.wall_seconds,
        cpu_seconds=result.cpu_seconds,
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_KIB,
        started=now - timedelta(seconds=result.wall_seconds),
        ended=now,
    )
