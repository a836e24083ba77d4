"""The clock of the driver's machine jumps by hours, forward and back, while trials run."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.orchestrate.faults.laboratory import Laboratory

JUMPS = ("+6h", "-6h", "-2h")


@pytest.fixture
def library() -> str:
    found = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    if found:
        return str(found[0])
    message = "the clock is moved by libfaketime: install Debian's package faketime"
    if os.environ.get("DOPT_REQUIRE_FAKETIME") == "1":
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture
def clock(tmp_path: Path) -> Path:
    """Return the file in which the time is set."""
    path = tmp_path / "clock"
    path.write_text("+0\n")
    return path


def test_nothing_is_lost_and_nobody_takes_over(
    url: str, laboratory_at: Callable[..., Laboratory], library: str, clock: Path
) -> None:
    environment = {
        "LD_PRELOAD": library,
        "FAKETIME_TIMESTAMP_FILE": str(clock),
        "FAKETIME_NO_CACHE": "1",
        "DONT_FAKE_MONOTONIC": "1",
    }
    laboratory = laboratory_at(url, trials=100)
    laboratory.gate.let(60)
    with laboratory.launched(environment=environment) as moved, ExitStack() as later:
        for done, jump in zip((5, 25, 45), JUMPS, strict=True):
            moved.until(lambda done=done: laboratory.count() >= done)  # type: ignore[misc]
            clock.write_text(f"{jump}\n")
        still = later.enter_context(laboratory.launched())
        laboratory.gate.open()
        assert [moved.end(), still.end()] == [0, 0], moved.errors + still.errors
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0
    assert laboratory.count("wall_seconds < 0 OR wall_seconds > 3600") == 0
    rates = [float(rate) for rate in re.findall(r"([\d.-]+)/s", moved.errors)]
    assert rates
    assert all(rate > 0 for rate in rates)
    hours = {ended[11:13] for (ended,) in laboratory.query("SELECT ended FROM attempt")}
    assert len(hours) > 1, "the clock was not moved"
