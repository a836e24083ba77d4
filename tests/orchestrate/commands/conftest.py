"""A small grid with every status in it, and commands run in this process."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import pytest

from orchestrate.__main__ import main
from orchestrate.store import Failure, LaunchRecord, RunRecord, Store
from tests.orchestrate.store.conftest import (  # noqa: F401  the same ones
    launch,
    open_store,
    reader,
    store,
    take,
)
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, diverged, result

SECRET = "hunter2"
RECORD: LaunchRecord = replace(
    LAUNCH, argv=("launch.py", "-m", f"store.url=postgresql://me:{SECRET}@host/db")
)
TRACEBACK = (
    "Traceback (most recent call last):\n"
    '  File "trial.py", line 7, in run\n'
    "    raise ZeroDivisionError\n"
    "ZeroDivisionError: seed {seed} is broken\n"
)


@dataclass
class Answer:
    """What a command gave back."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one JSON document of the output; NaN and the like are errors."""
        return json.loads(self.out, parse_constant=_refuse)


def _refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is not JSON")


on_both = pytest.mark.parametrize("url", ["sqlite", "postgresql"], indirect=True)


@pytest.fixture
def url(request: pytest.FixtureRequest) -> str:
    """URL of a file, or with ``on_both`` of each kind: commands use the store, which has both."""
    return str(request.getfixturevalue(f"{getattr(request, 'param', 'sqlite')}_url"))


@pytest.fixture
def command(url: str, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Return a function that runs ``python -m orchestrate`` on the database."""

    def run(*words: str) -> Answer:
        capsys.readouterr()
        code = main([*words, "--db", url])
        return Answer(code, *capsys.readouterr())

    return run


def run_now() -> RunRecord:
    moment = datetime.now(UTC)
    return replace(RUN, started=moment, ended=moment)


def failure(seed: int, cause: str = "exception") -> Failure:
    text = TRACEBACK.format(seed=seed)
    return Failure("ZeroDivisionError", f"seed {seed} is broken", text, cause)


DONE = [Spec(seed, policy="random") for seed in range(3)]
BROKEN = [Spec(seed, policy="d_optimal") for seed in (3, 4)]
BAD = Spec(5, policy="d_optimal")
RUNNING = Spec(0, env="cartpole", width=8)
WAITING = [Spec(seed, env="cartpole", width=None) for seed in range(2)]


@pytest.fixture
def grid(store: Store) -> int:  # noqa: F811
    """Fill the database: 3 done, 1 diverged, 2 failed, 1 running, 2 pending; return the launch."""
    number = store.begin_launch(RECORD)
    todo = store.register(number, [*DONE, *BROKEN, BAD, RUNNING, *WAITING]).todo
    claims = store.claim(number, todo[: -len(WAITING)])
    for spec, claim in zip(DONE, claims[:3], strict=True):
        store.commit(claim, result(spec.seed), run_now())
    for spec, claim in zip(BROKEN, claims[3:5], strict=True):
        store.fail(claim, failure(spec.seed), run_now())
    store.commit(claims[5], diverged(3, seed=BAD.seed), run_now())
    return number


@pytest.fixture
def ask(grid: int, command: Callable[..., Answer]) -> Callable[..., Answer]:  # noqa: ARG001
    """Return ``command`` on the database with the grid."""
    return command
