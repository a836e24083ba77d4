"""Regular copies of the database of a share to the folder in which all shares are collected."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.store import DatabaseMovedError, StoreError
from orchestrate.store.shards import collect, merge_collected

REST = 20.0
"""Least time between two copies, as a multiple of the time that a copy takes."""


@contextmanager
def collected(settings: LaunchSettings, warn: Callable[[str], None]) -> Iterator[None]:
    """Copy the database of the block every ``collect_seconds`` or less often, and once after it.

    What earlier launches of the share have collected, perhaps on machines that are gone, is merged
    before the block. Without a folder nothing is copied.

    Raises
    ------
    StoreError
        If what was collected cannot be merged, or the last copy fails; the local database is kept.
    """
    if settings.collect_in is None:
        yield
        return
    folder, ended = settings.collect_in, threading.Event()
    earlier = f"*.{settings.share}.*.db"
    if any(folder.glob(earlier)):
        for _ in merge_collected(settings.store_url, folder, earlier):
            pass

    def copy_regularly() -> None:
        pause = settings.collect_seconds
        while not ended.wait(pause):
            start = time.monotonic()
            try:
                collect(settings.store_url, folder)
            except StoreError as error:
                warn(f"the results are not copied yet: {error}")
            pause = max(settings.collect_seconds, REST * (time.monotonic() - start))

    thread = threading.Thread(target=copy_regularly, name="collect", daemon=True)
    thread.start()
    try:
        yield
    except DatabaseMovedError:  # another database may have its name
        _stop(thread, ended)
        raise
    except BaseException:
        _stop(thread, ended)
        with suppress(StoreError):  # the first error is the one to report
            collect(settings.store_url, folder)
        raise
    _stop(thread, ended)
    collect(settings.store_url, folder)


def _stop(thread: threading.Thread, ended: threading.Event) -> None:
    ended.set()
    thread.join()
