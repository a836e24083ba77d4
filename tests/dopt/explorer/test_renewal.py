"""Posteriors of Gaussian processes that are made beside an exploration."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.models import gaussian_process
from tests.dopt.explorer.plants import HOVERCRAFT, MOTOR, following, steered
from tests.waiting import until

PLANTS = {"motor": (MOTOR, following), "hovercraft": (HOVERCRAFT, steered)}


def explorer(plant: str = "motor", **more: Any) -> Explorer:
    evidence = {"name": "gaussian_process", "hyperparameters": "evidence"}
    given = {"policy": "random", "model": evidence, "learner": "conditioning", "deadline": 1.0}
    return Explorer(PLANTS[plant][0], **{**given, "steps": 200, "seed": 1, **more})


def drive(one: Explorer, steps: int, plant: str = "motor", every: int = 3) -> None:
    """Take steps; after so many what runs beside is waited for."""
    about, follows = PLANTS[plant]
    noise = np.random.default_rng(one.n_steps)
    x = one.states[one.n_steps] if one.n_steps else np.zeros(len(about.states))
    fits = one._fits
    assert fits is not None
    for t in range(steps):
        x = follows(x, one.ask(x)) + 1e-3 * noise.standard_normal(len(x))
        one.tell(x)
        if t % every == 0:
            until(lambda: fits.is_ready or not fits.is_running)


def events(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("room", [30, 2000])
def test_a_replay_makes_the_same_posterior(
    plant: str, room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where samples are thinned, and where some came while it was made."""
    monkeypatch.setattr(gaussian_process, "MOST_SAMPLES", room)
    path = tmp_path / "run.jsonl"
    with explorer(plant, journal=path) as one:
        drive(one, 90, plant)
        before, refits = one.parameters.copy(), one.counts["refits"]
        state = one._state
        factors = state._trial.state.posterior
        kept = [part.copy() for part in factors[1:5]]
    assert refits >= 3
    between = [event for event in events(path) if event.keys() & {"refit", "renewed", "learn"}]
    began = [k for k, event in enumerate(between) if "refit" in event]
    assert all(between[k]["beside"] and "learn" in between[k + 1] for k in began[:-1])
    with explorer(plant, journal=path, deadline=None) as again:
        np.testing.assert_array_equal(again.parameters, before)
        assert again.counts["refits"] == refits
        for left, right in zip(kept, again._state._trial.state.posterior[1:5], strict=True):
            np.testing.assert_array_equal(left, right)
        drive(again, 20, plant)


def test_a_process_that_fails_delays_what_it_was_to_make(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.jsonl"
    with explorer(journal=path) as one:
        fits = one._fits
        assert fits is not None
        while one._state.renewal is None or not fits.is_running:
            drive(one, 1)
        # The request may be answered already: the next one is not.
        assert fits._process is not None
        fits.take()
        fits._process.kill()
        fits.begin(one._state.renewal.request(), fits.rows, one._state.renewal.install)
        until(lambda: fits.is_ready)
        drive(one, 1)
        assert one._state.renewal is None
        before = one.parameters.copy()
    assert "no fit" in caplog.text
    with explorer(journal=path) as again:
        np.testing.assert_array_equal(again.parameters, before)


KILLED = """
import sys
from tests.dopt.explorer.test_renewal import drive, explorer
with explorer(journal=sys.argv[1], fsync=False) as one:
    while True:
        drive(one, 1)
        pending = one._state.renewal is not None
        print(one.n_steps, pending, one.parameters.tobytes().hex(), flush=True)
"""


def test_what_was_being_made_when_the_process_was_killed_is_made_again(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    code = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(code, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        told = {}
        for line in process.stdout:
            steps, pending, parameters = line.split()
            told[int(steps)] = parameters
            if pending == "True" and int(steps) > 15:
                os.kill(process.pid, signal.SIGKILL)
                break
    with explorer(journal=path) as again:
        n = again.n_steps
        assert told.get(n, again.parameters.tobytes().hex()) == again.parameters.tobytes().hex()
        refits = again.counts["refits"]
        drive(again, 5, every=1)
        assert again.counts["refits"] > refits
        before = again.parameters.copy()
    with explorer(journal=path) as last:
        np.testing.assert_array_equal(last.parameters, before)


def test_a_journal_without_renewals_is_replayed_as_it_was(tmp_path: Path) -> None:
    """Without a deadline numbers come into force at once, as they did before."""
    path = tmp_path / "run.jsonl"
    with explorer(journal=path, deadline=None) as one:
        drive(one, 40)
        before = one.parameters.copy()
    assert not [event for event in events(path) if "renewed" in event or "beside" in event]
    with explorer(journal=path) as again:
        np.testing.assert_array_equal(again.parameters, before)
