"""Processes that use a database in the tests of faults, each forked from a clean server."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection as Pipe
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Barrier
from typing import Any

import sqlalchemy

from orchestrate.store import Store
from orchestrate.store import maintenance as migration
from orchestrate.store import merge as merging
from orchestrate.store.maintenance import upgrade
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, begin, result
from tests.waiting import PATIENCE_SECONDS

# Forked from a process that has imported everything and opened nothing: starts in milliseconds.
CLEAN = multiprocessing.get_context("forkserver")
_LATER = ("llvmlite.binding", "numpy.random")  # a launch imports them on its way
CLEAN.set_forkserver_preload(["pytest", "psycopg", "orchestrate.runner.start", *_LATER, __name__])
NOBODY = 65534


@contextmanager
def running(target: Callable[..., None], *arguments: Any) -> Iterator[tuple[BaseProcess, Pipe]]:
    """Run ``target(pipe, *arguments)`` in a process that is dead after the block."""
    here, there = CLEAN.Pipe()
    process = CLEAN.Process(target=target, args=(there, *arguments), daemon=True)
    process.start()
    there.close()
    try:
        yield process, here
    finally:
        kill(process)
        here.close()


def kill(process: BaseProcess) -> None:
    """Kill -9, and wait until the kernel has taken everything back."""
    process.kill()
    process.join(PATIENCE_SECONDS)


def hear(pipe: Pipe) -> Any:
    assert pipe.poll(PATIENCE_SECONDS), "the other process says nothing"
    return pipe.recv()


def open_together(pipe: Pipe, urls: Sequence[str], barrier: Barrier) -> None:
    """Open each database at the same moment as the others do; say how it went.

    One that hangs shows where it does, before the test gives up; after an error of one the others
    do not wait for it, so that the test shows the error.
    """
    faulthandler.dump_traceback_later(PATIENCE_SECONDS / 2)
    try:
        for url in urls:
            barrier.wait(PATIENCE_SECONDS)
            with Store.open(url) as store:
                store.begin_launch(LAUNCH)
        faulthandler.cancel_dump_traceback_later()
        pipe.send("opened")
    except Exception as error:
        barrier.abort()
        pipe.send(repr(error))


def eight_open(urls: Sequence[str]) -> None:
    """Let eight processes open each of the databases at once; all must succeed."""
    barrier = CLEAN.Barrier(8)
    with ExitStack() as stack:
        pipes = [stack.enter_context(running(open_together, urls, barrier))[1] for _ in range(8)]
        answers = [hear(pipe) for pipe in pipes]
        assert answers == ["opened"] * 8, answers


def hold_claims(pipe: Pipe, url: str, n: int) -> None:
    """Claim n trials, tell which, and do nothing more."""
    with Store.open(url) as store:
        pipe.send(begin(store, *map(Spec, range(n)))[1])
        pipe.recv()


def run_and_stop(pipe: Pipe, url: str, n: int) -> None:
    """Commit n trials of a grid of twice as many, one at a time, and stop for ever."""
    store = Store.open(url)
    for claim in begin(store, *map(Spec, range(2 * n)))[1][:n]:
        store.commit(claim, result(claim.trial_id), RUN)
    pipe.send("committed")
    time.sleep(PATIENCE_SECONDS)


def without_rights(pipe: Pipe, side: Callable[[str], Any], url: str) -> None:
    """Open a database as a user who owns nothing, and tell what came of it."""
    if os.geteuid() == 0:
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
    try:
        pipe.send(side(url))
    except Exception as error:
        pipe.send(error)


def upgrade_and_tell(pipe: Pipe, url: str, barrier: Barrier | None, stops: bool = False) -> None:
    """Upgrade at the same moment as others do, or stop for ever before the last change."""
    if stops:

        def stop(_: sqlalchemy.Connection) -> None:
            pipe.send("half")
            time.sleep(PATIENCE_SECONDS)

        migration.create_views = stop
    if barrier is not None:
        barrier.wait(PATIENCE_SECONDS)
    pipe.send("upgraded" if upgrade(url).changed else "nothing to do")


def merge_and_tell(pipe: Pipe, url: str, other: str, after: int) -> None:
    """Merge with pages of three trials, and stop for ever before the given one."""
    merging.PAGE = 3
    add = merging.Target.add
    count = 0

    def stop(*arguments: Any) -> None:
        nonlocal count
        if count == after:
            pipe.send("in the middle")
            time.sleep(PATIENCE_SECONDS)
        count += 1
        add(*arguments)

    merging.Target.add = stop  # type: ignore[method-assign]
    merging.merge(url, other)
