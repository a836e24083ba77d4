"""A journal holds all that an explorer is: reopened at any time, it goes on as an undisturbed one.

Calls are drawn in any order: questions, answers, repeated, old, lost and late states, resets, plans
that are not ready in time, with closings in between.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.errors import ExplorationError
from tests.dopt.explorer.plants import HOVERCRAFT, steered
from tests.waiting import PATIENCE_SECONDS

SHORT = {"name": "icem", "lookahead": 6, "hold": 3, "stride": 3, "plans": 8, "elites": 3}

SETTINGS: dict[str, Any] = {
    "policy": SHORT,
    "learner": "gauss_newton",
    "steps": 80,
    "deadline": PATIENCE_SECONDS,
    "fallback": [0.25, -0.25],
}


def opened(journal: Path) -> Explorer:
    return Explorer(HOVERCRAFT, journal=journal, fsync=False, **SETTINGS)


def condition(explorer: Explorer) -> dict[str, Any]:
    """Return all by which an exploration goes on."""
    state = explorer._state
    return {
        "n_steps": explorer.n_steps,
        "counts": {k: v for k, v in explorer.counts.items() if k != "missed"},
        "missed": explorer.counts["missed"],
        "parameters": explorer.parameters.tobytes(),
        "answer": None if state.answer is None else state.answer.tobytes(),
        "present": None if state.present is None else state.present.tobytes(),
        "time": state.time,
        "errors": explorer.errors.tobytes(),
    }


@contextmanager
def slow_plans(explorer: Explorer) -> Iterator[None]:
    """Let no plan be ready in time until the end."""
    may_end, plan = threading.Event(), explorer._state.plan
    planner: Any = explorer._planner
    before = planner._make, planner._deadline

    def slow() -> None:
        may_end.wait(PATIENCE_SECONDS)
        plan()

    planner._make, planner._deadline = slow, 0.001
    try:
        yield
    finally:
        may_end.set()
        planner._make, planner._deadline = before


class Plant:
    """The hovercraft with its clock, and an explorer that meets all kinds of calls."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.x, self.now, self.u = np.array([0.1, 0.2, 0.0]), 0.0, np.zeros(2)

    def call(self, explorer: Explorer) -> None:
        """Make one drawn call."""
        kinds = ["ask", "late", "tell", "tell", "tell", "again", "old", "nan", "gap", "reset"]
        kind = self.rng.choice(kinds, p=[0.3, 0.08, 0.15, 0.15, 0.1, 0.06, 0.05, 0.04, 0.04, 0.03])
        match kind:
            case "ask":
                self.u = explorer.ask(self.x, time=self.now)
            case "late":
                with slow_plans(explorer):
                    self.u = explorer.ask(self.x, time=self.now)
            case "tell":
                self._move(HOVERCRAFT.dt * self.rng.uniform(0.8, 1.2))
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "again":
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "old":
                explorer.tell(self.x + 0.1, applied=self.u, time=self.now - 0.03)
            case "nan":
                self._move(HOVERCRAFT.dt)
                explorer.tell(self.x * np.nan, applied=self.u, time=self.now)
            case "gap":
                self._move(3.0 * HOVERCRAFT.dt)
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "reset":
                explorer.reset()

    def _move(self, dt: float) -> None:
        self.x, self.now = steered(self.x, self.u, dt), self.now + dt


@pytest.mark.parametrize("seed", range(6))
def test_it_goes_on_as_if_it_had_not_been_closed(seed: int, tmp_path: Path) -> None:
    whole, cut = opened(tmp_path / "whole.jsonl"), opened(tmp_path / "cut.jsonl")
    one, other = Plant(seed), Plant(seed)
    closings = np.random.default_rng(100 + seed)
    for _ in range(60):
        one.call(whole)
        other.call(cut)
        assert condition(cut) == condition(whole)
        if closings.random() < 0.2:
            cut.close()
            cut = opened(tmp_path / "cut.jsonl")
            whole._wait()  # as closing does: a late plan ends before
            assert condition(cut) == condition(whole)
    assert np.array_equal(cut.ask(one.x, time=one.now), whole.ask(one.x, time=one.now))
    whole.close()
    cut.close()


def test_measured_times_are_learned_from_and_replayed(tmp_path: Path) -> None:
    """A quarter more than dt, taken for dt, would be another acceleration and other parameters."""
    told = opened(tmp_path / "told.jsonl")
    x = np.array([0.1, 0.2, 0.0])
    u = told.ask(x, time=0.0)
    assert told.tell(steered(x, u, 0.025), time=0.025)
    exact = Explorer(HOVERCRAFT, **SETTINGS)
    exact.ask(x)
    slope = (steered(x, u, 0.025) - x) / 0.025
    assert exact.tell(x + HOVERCRAFT.dt * slope, applied=u)
    assert told.parameters == pytest.approx(exact.parameters, rel=1e-9)
    before = condition(told)
    told.close()
    again = opened(tmp_path / "told.jsonl")
    assert condition(again) == before
    again.close()


def test_ctrl_c_waits_until_a_call_is_whole(tmp_path: Path) -> None:
    """It comes while the event is written: the event is also done, once, and then it is raised."""
    explorer = opened(tmp_path / "run.jsonl")
    x = np.array([0.1, 0.2, 0.0])
    u = explorer.ask(x)
    journal: Any = explorer._journal
    write = journal.write

    def interrupted(event: Any, *, durable: bool) -> None:
        write(event, durable=durable)
        os.kill(os.getpid(), signal.SIGINT)

    journal.write = interrupted
    with pytest.raises(KeyboardInterrupt):
        explorer.tell(steered(x, u))
    journal.write = write
    before = condition(explorer)
    assert before["n_steps"] == 1
    explorer.close()
    again = opened(tmp_path / "run.jsonl")
    assert condition(again) == before
    again.close()


def test_a_question_during_a_late_plan_does_not_wait() -> None:
    explorer = Explorer(HOVERCRAFT, **SETTINGS)
    x = np.array([0.1, 0.2, 0.0])
    u = explorer.ask(x)
    x = steered(x, u)
    explorer.tell(x)
    with slow_plans(explorer):
        assert np.array_equal(explorer.ask(x), [0.25, -0.25])
        assert explorer._planner.is_late
        assert np.array_equal(explorer.ask(x), [0.25, -0.25])
        assert explorer._planner.is_late
    assert explorer.tell(steered(x, np.array([0.25, -0.25])))
    assert explorer.counts["missed"] == 1
    explorer.close()


def test_an_exploration_that_is_closed_says_so(tmp_path: Path) -> None:
    explorer = opened(tmp_path / "run.jsonl")
    explorer.close()
    explorer.close()
    with pytest.raises(ExplorationError, match="is closed"):
        explorer.ask([0.1, 0.2, 0.0])


def test_an_explorer_that_is_forgotten_frees_its_journal(tmp_path: Path) -> None:
    """As a cell of a notebook that is run twice leaves one behind."""
    explorer = Explorer(HOVERCRAFT, steps=5, journal=tmp_path / "run.jsonl")
    with pytest.warns(ResourceWarning):
        del explorer
    Explorer(HOVERCRAFT, steps=5, journal=tmp_path / "run.jsonl").close()
