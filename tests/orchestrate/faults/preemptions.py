"""Workers on one database, of which a random one is preempted again and again."""

from __future__ import annotations

import random
import signal
from collections import Counter
from contextlib import ExitStack

from tests.orchestrate.faults.laboratory import Laboratory, Launched
from tests.waiting import until

OPEN = "status IN ('pending', 'running')"

PREEMPTIONS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)

EXIT_CODES = {0, 130}
"""A worker that is asked to leave may find that everything is done."""


def preempt(
    laboratory: Laboratory, workers: int, every: int, chance: random.Random, **worker: object
) -> Counter[str]:
    """Run the registered grid on workers of which one is replaced after ``every`` trials.

    Returns how often each signal was sent.
    """
    sent: Counter[str] = Counter()
    with ExitStack() as stack:

        def start() -> Launched:
            return stack.enter_context(laboratory.launched(worker=worker))

        running = [start() for _ in range(workers)]
        while (left := laboratory.count(OPEN)) > 4 * every:
            laboratory.gate.let(2 * every)  # so that the victim is at work, and not at its end
            until(lambda: laboratory.count(OPEN) <= left - every)  # called at once
            victim = chance.choice(running)
            victim.until(lambda: "trials wait" in victim.said)  # noqa: B023
            number = chance.choice(PREEMPTIONS)
            running[running.index(victim)] = start()
            sent[number.name] += 1
            leave(victim, number)
            if number == signal.SIGKILL:
                laboratory.end_lease(victim)
        laboratory.gate.open()
        codes = [one.end() for one in running]
    assert set(codes) == {0}, codes
    return sent


def leave(worker: Launched, number: signal.Signals) -> None:
    """Send a worker a signal and wait until it has left as it should."""
    worker.send(number)
    code = worker.end()
    allowed = EXIT_CODES | ({-signal.SIGKILL} if number == signal.SIGKILL else set())
    assert code in allowed, f"{number.name}: {code}: {worker.said}{worker.errors}"
    assert "Traceback" not in worker.errors, worker.errors
