"""Several launches of one grid at once, which share a database that none of them has made yet."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from tests.orchestrate.faults.laboratory import Laboratory


@pytest.mark.parametrize(("launches", "executor"), [(2, "local"), (8, "inprocess")])
def test_nothing_is_run_twice(laboratory: Laboratory, launches: int, executor: str) -> None:
    with ExitStack() as stack:
        started = [
            stack.enter_context(laboratory.launched(executor=executor)) for _ in range(launches)
        ]
        codes = [launched.end() for launched in started]
    assert codes == [0] * launches, [launched.errors for launched in started]
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0
    assert laboratory.query("SELECT DISTINCT state FROM launch") == [("done",)]
    for launched in started:
        assert f"{laboratory.order.trials} of {laboratory.order.trials}" in launched.said
