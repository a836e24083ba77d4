"""Gives the same command again and again, disturbs it, and keeps account."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from tabulate import tabulate

from tests.orchestrate.faults.laboratory import Laboratory, Launched
from tests.orchestrate.faults.servers import Server
from tests.soak.disturbances import Disturbance, Scene

EXECUTORS = ("local", "local", "local", "inprocess", "local", "ray")
"""In turn, from one start to the next."""

PAUSE_SECONDS = (0.5, 2.5)


@dataclass
class Supervisor:
    """Brings a grid to its end in spite of everything.

    Attributes
    ----------
    seen
        How often each disturbance was followed by what.
    """

    laboratory: Laboratory
    server: Server | None
    disturbances: Sequence[Disturbance]
    chance: random.Random
    seen: dict[str, Counter[str]] = field(default_factory=dict)
    starts: int = 0
    deck: list[Disturbance] = field(default_factory=list)

    def run(self) -> None:
        """Start launches until one of them says that all is done."""
        code = -1
        while code != 0:
            executor = EXECUTORS[self.starts % len(EXECUTORS)]
            self.starts += 1
            with self.laboratory.launched(executor=executor) as launched:
                code = self._disturb(launched)

    def _disturb(self, launched: Launched) -> int:
        """Disturb the launch until it ends; return its exit code."""
        allowed = {0}
        scene = Scene(self.laboratory, launched, self.server, self.chance)
        while not self._ends_within(launched, self.chance.uniform(*PAUSE_SECONDS)):
            disturbance = self._draw()
            allowed |= set(disturbance.codes)
            self._cause(disturbance, scene)
        code = launched.end()
        assert code in allowed, f"exit code {code}: {launched.said}{launched.errors}"
        assert "Traceback" not in launched.errors, launched.errors
        return code

    def _draw(self) -> Disturbance:
        """Return each disturbance once, in a random order, before any of them comes again."""
        if not self.deck:
            self.deck = self.chance.sample(self.disturbances, len(self.disturbances))
        return self.deck.pop()

    def _cause(self, disturbance: Disturbance, scene: Scene) -> None:
        disturbance.cause(scene)
        launched = scene.launched
        ended = self._ends_within(launched, 0.5)
        what = f"exit code {launched.end()}" if ended else "went on"
        self.seen.setdefault(disturbance.name, Counter())[what] += 1

    @staticmethod
    def _ends_within(launched: Launched, seconds: float) -> bool:
        launched.process.join(seconds)
        return not launched.process.is_alive()

    def table(self) -> str:
        """Return what was done, how often, and what came of it."""
        rows = [
            (name, sum(seen.values()), ", ".join(f"{n} {what}" for what, n in seen.most_common()))
            for name, seen in sorted(self.seen.items())
        ]
        return tabulate(rows, headers=["fault", "times", "the launch"], tablefmt="github")
