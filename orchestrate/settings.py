"""How a grid is run, as checked values; nothing of it is part of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from dopt.errors import unknown_name
from orchestrate.errors import LaunchError

RETRY = ("failed", "diverged", "all")
EXECUTORS = ("inprocess", "local", "lockstep", "ray")

LARGEST = 1_000_000_000
"""Bound of seconds and GiB, beyond which the system's clocks and limits count no further."""

Retry = Literal["failed", "diverged", "all"]


@dataclass(frozen=True)
class LaunchSettings:
    """Settings of one launch.

    Attributes
    ----------
    executor
        One of :data:`EXECUTORS`.
    store_url
        SQLAlchemy URL of the results database.
    workers
        Processes, or None for one on each core.
    chunk_seconds
        Work that a worker gets at once.
    timeout
        Seconds of wall time that one trial may take, or None for no limit.
    memory_gib
        Memory that one worker process may take, or None for no limit.
    lease
        Seconds after its last sign of life for which a launch on PostgreSQL keeps its trials.
    patience
        Seconds that a launch waits for a database that went away.
    retry
        Trials of the grid that are run again although they have an outcome.
    device, batch
        Torch device of the lockstep executor and trials in one of its batches.
    """

    executor: str
    store_url: str
    dry_run: bool = False
    fail_fast: bool = False
    retry: Retry | None = None
    workers: int | None = None
    chunk_seconds: float = 1.0
    timeout: float | None = 3600.0
    memory_gib: float | None = None
    lease: float = 60.0
    patience: float = 30.0
    ray_address: str = "local"
    device: str = "cpu"
    batch: int = 100

    @property
    def path(self) -> str:
        """Execution path of the trials: the kernel where it knows all parts.

        A batch in lockstep is the reference's.
        """
        return "reference" if self.executor == "lockstep" else "kernel"

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> LaunchSettings:
        """Check the sections ``launch``, ``store`` and ``executor`` of a configuration.

        Raises
        ------
        LaunchError
            If a value has the wrong type or is out of bounds.
        """
        launch = _section("launch", given["launch"])
        executor = _section("executor", given["executor"])
        name = executor["name"]
        if name not in EXECUTORS:
            raise unknown_name("executor.name", name, EXECUTORS)
        retry = launch["retry"]
        if retry is not None and retry not in RETRY:
            raise unknown_name("launch.retry", retry, RETRY)
        return cls(
            executor=name,
            store_url=_text("store.url", _section("store", given["store"])["url"]),
            dry_run=_flag("launch.dry_run", launch["dry_run"]),
            fail_fast=_flag("launch.fail_fast", launch["fail_fast"]),
            retry=cast("Retry | None", retry),
            workers=_count("launch.workers", launch["workers"]),
            chunk_seconds=_amount("launch.chunk_seconds", launch["chunk_seconds"], "seconds"),
            timeout=_limit("launch.timeout", launch["timeout"], "seconds"),
            memory_gib=_limit("launch.memory_gib", launch["memory_gib"], "GiB"),
            **_waiting(launch["lease"], launch["patience"]),
            ray_address=_text(
                "launch.ray.address", _section("launch.ray", launch["ray"])["address"]
            ),
            device=_text("executor.device", executor.get("device", cls.device)),
            batch=_count("executor.batch", executor.get("batch", cls.batch)) or cls.batch,
        )


def _section(key: str, value: object) -> Mapping[str, Any]:
    if isinstance(value, Mapping):
        return value
    raise _wrong(key, value, "a section with settings of its own")


def _flag(key: str, value: object) -> bool:
    if isinstance(value, bool):
        return value
    raise _wrong(key, value, "true or false")


def _text(key: str, value: object) -> str:
    if isinstance(value, str) and value:
        return value
    raise _wrong(key, value, "a text")


def _count(key: str, value: object) -> int | None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool) and value > 0):
        return value
    raise _wrong(key, value, "null or a whole number above 0")


def _limit(key: str, value: object, unit: str) -> float | None:
    return None if value is None else _amount(key, value, unit, "null or a number")


def _amount(key: str, value: object, unit: str, kind: str = "a number") -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < LARGEST:
        return float(value)
    raise _wrong(key, value, f"{kind} of {unit} above 0 and below {LARGEST:,}")


def _waiting(lease: object, patience: object) -> dict[str, float]:
    """Check that the trials of a launch that waits for its database remain its own."""
    seconds = {
        "lease": _amount("launch.lease", lease, "seconds"),
        "patience": _amount("launch.patience", patience, "seconds"),
    }
    if seconds["patience"] >= seconds["lease"]:
        raise _wrong("launch.patience", patience, f"less than launch.lease={lease}")
    return seconds


def _wrong(key: str, value: object, expected: str) -> LaunchError:
    return LaunchError(f"{key} is {value!r}, but {expected} is expected: set it so.")
