"""Workers on one database, of which a random one is preempted again and again."""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from contextlib import ExitStack

from tests.orchestrate.faults.laboratory import PATIENCE_SECONDS, Laboratory, Launched

OPEN = "status IN ('pending', 'running')"

PREEMPTIONS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)

EXIT_CODES = {0, 130}
"""A worker that is asked to leave may find that everything is done."""


def preempt(
    laboratory: Laboratory, workers: int, pause: float, chance: random.Random, **worker: object
) -> Counter[str]:
    """Run the registered grid on workers of which one is replaced every ``pause`` seconds.

    Returns how often each signal was sent.
    """
    sent: Counter[str] = Counter()
    end = time.monotonic() + PATIENCE_SECONDS + laboratory.order.trials * laboratory.order.seconds
    with ExitStack() as stack:

        def start() -> Launched:
            return stack.enter_context(laboratory.launched(worker=worker))

        running = [start() for _ in range(workers)]
        while laboratory.count(OPEN):
            assert time.monotonic() < end, [one.said + one.errors for one in running]
            time.sleep(pause)
            victim = chance.choice(running)
            number = chance.choice(PREEMPTIONS)
            running[running.index(victim)] = start()
            if begun(victim):
                sent[number.name] += 1
                leave(victim, number)
        codes = [one.end() for one in running]
    assert set(codes) == {0}, codes
    return sent


def begun(worker: Launched) -> bool:
    """Tell whether a worker has looked for trials, and still runs."""
    return "trials wait" in worker.said and worker.process.is_alive()


def leave(worker: Launched, number: signal.Signals) -> None:
    """Send a worker a signal and wait until it has left as it should."""
    worker.send(number)
    code = worker.end()
    allowed = EXIT_CODES | ({-signal.SIGKILL} if number == signal.SIGKILL else set())
    assert code in allowed, f"{number.name}: {code}: {worker.said}{worker.errors}"
    assert "Traceback" not in worker.errors, worker.errors
