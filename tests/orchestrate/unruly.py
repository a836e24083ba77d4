"""Stand-ins for a trial that takes too long or too much, and heeds nothing or little."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from pathlib import Path

import numpy as np

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from tests.orchestrate.standins import BROKEN_SEED, quick

FOR_EVER = 600


def hanging(spec: TrialSpec) -> TrialResult:
    """Hang in Python, and take the interruption for any other exception."""
    if spec.seed == BROKEN_SEED:
        wait_for_nothing()
    return quick(spec)


def wait_for_nothing() -> None:
    try:
        time.sleep(FOR_EVER)
    except Exception:
        time.sleep(FOR_EVER)


def deaf(spec: TrialSpec) -> TrialResult:
    """Hang in native code that holds the interpreter's lock, and again after a signal."""
    if spec.seed == BROKEN_SEED:
        sleep_natively()
    return quick(spec)


def sleep_natively() -> None:
    pause = ctypes.PyDLL(None).pause  # returns after a signal, whose handler then runs in Python
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    pause()


def greedy(spec: TrialSpec) -> TrialResult:
    """Ask for 64 GiB in small pieces, and use them."""
    if spec.seed == BROKEN_SEED:
        hoard()
    return quick(spec)


def hoard() -> None:
    held = [np.ones(2**21) for _ in range(64 * 64)]
    raise AssertionError(f"there was room for {len(held)} arrays")


def faulty(spec: TrialSpec) -> TrialResult:
    """Touch memory that is not there."""
    if spec.seed == BROKEN_SEED:
        ctypes.string_at(0)
    return quick(spec)


def empty(spec: TrialSpec) -> TrialResult:
    """Return nothing."""
    return None if spec.seed == BROKEN_SEED else quick(spec)  # type: ignore[return-value]


def greedy_in_a_group(spec: TrialSpec) -> TrialResult:
    """Hoard in a control group with little memory, whose limit is the kernel's to enforce."""
    if spec.seed == BROKEN_SEED:
        Path(os.environ["DOPT_TEST_GROUP"], "cgroup.procs").write_text(str(os.getpid()))
        hoard()
    return quick(spec)


def wants_a_gigabyte(spec: TrialSpec) -> TrialResult:
    """Use 1 GiB, and give it back."""
    if spec.seed == BROKEN_SEED:
        np.ones(2**27)
    return quick(spec)
