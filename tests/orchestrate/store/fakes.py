"""Trials without physics: what the store needs of a specification and of a result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.result import Assessment
from orchestrate.store import Claim, Failure, LaunchRecord, Reader, RunRecord, Store
from orchestrate.store.schema import OUTCOME

Array = npt.NDArray[np.float64]

HORIZON = 7
MOMENT = datetime(2026, 1, 31, 12, 0, 0, 250, tzinfo=UTC)
LAUNCH = LaunchRecord(
    argv=("launch.py", "-m"),
    overrides=("env=glob(*)",),
    host="here",
    pid=17,
    git_commit="0" * 40,
    git_dirty=True,
    git_diff_hash="1" * 64,
    versions={"numpy": np.__version__},
)
RUN = RunRecord(
    node="here",
    pid=18,
    wall_seconds=0.5,
    cpu_seconds=0.25,
    peak_memory_bytes=2**33,
    started=MOMENT,
    ended=MOMENT,
)
FAILURE = Failure("ValueError", "no", "Traceback: no")


@dataclass(frozen=True)
class Spec:
    seed: int = 0
    env: str = "pendulum"
    policy: str = "random"
    width: int | None = 16
    horizon: int = HORIZON
    gamma: float = 1.5
    task: str | None = None

    @property
    def label(self) -> str:
        usual = {"width": 16, "horizon": HORIZON, "gamma": 1.5, "task": None}
        own = [f"{k}={getattr(self, k)}" for k, v in usual.items() if getattr(self, k) != v]
        return ", ".join([self.policy, *own])

    def columns(self) -> Mapping[str, Any]:
        return {
            "env": self.env,
            "policy": self.policy,
            "model": "mlp",
            "learner": "adam_window",
            "width": self.width,
            "depth": 2,
            "horizon": self.horizon,
            "dt": 0.01,
            "gamma": self.gamma,
            "label": self.label,
        }

    @property
    def config_json(self) -> str:
        task = {} if self.task is None else {"task": {"name": self.task}}
        return json.dumps({**self.columns(), **task}, sort_keys=True, default=int)

    @property
    def config_key(self) -> str:
        return _digest(self.config_json)

    @property
    def trial_key(self) -> str:
        return _digest(f'{self.config_json[:-1]},"seed":{int(self.seed)}}}')


@dataclass(frozen=True)
class FakeResult:
    loss: Array
    reachable_loss: Array
    plan_us: Array
    learn_us: Array
    evaluate_us: Array
    states: Array
    inputs: Array
    parameters: Array
    diverged_at: int | None
    n_steps: int
    final_loss: float | None
    best_loss: float | None
    assessments: tuple[Assessment, ...] = ()

    def __getattr__(self, name: str) -> None:
        """Return None for a column of the outcome that these tests do not know."""
        if name not in OUTCOME:
            raise AttributeError(name)


def result(seed: int = 0, horizon: int = HORIZON) -> FakeResult:
    """Return a result whose every number depends on the seed."""
    random = np.random.default_rng(seed)
    steps = [random.random(horizon) for _ in range(5)]
    return FakeResult(
        *steps,
        states=random.random((horizon + 1, 4)),
        inputs=random.random((horizon, 2)),
        parameters=random.random(11),
        diverged_at=None,
        n_steps=horizon,
        final_loss=float(steps[0][-1]),
        best_loss=float(steps[0].min()),
    )


def assessed(seed: int = 0) -> FakeResult:
    """Return a result with a number that is not finite in its assessment."""
    random = np.random.default_rng(1000 + seed)
    rows = [Assessment(t, name, random.random()) for t in (0, 3, 7) for name in ("cost", "error")]
    return replace(result(seed), assessments=(*rows[:-1], rows[-1]._replace(value=np.inf)))


def diverged(at: int, seed: int = 0, value: float = np.nan) -> FakeResult:
    """Return a result with the value, not finite, in each row from the given one on."""
    whole = result(seed)
    steps = {
        name: np.where(np.arange(HORIZON) < at, getattr(whole, name), value)
        for name in ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")
    }
    best = float(steps["loss"][:at].min()) if at else None
    return replace(whole, **steps, diverged_at=at, n_steps=at, final_loss=None, best_loss=best)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def begin(store: Store, *specs: Spec) -> tuple[int, list[Claim]]:
    """Begin a launch that registers and claims trials; return its number and the claims."""
    launch = store.begin_launch(LAUNCH)
    return launch, store.claim(launch, store.register(launch, specs).todo)


def run_all(
    url: str,
    *specs: Spec,
    make: Callable[[Spec], FakeResult] = lambda one: result(one.seed, one.horizon),
) -> None:
    """Write the results of trials into a database, by one launch that ends."""
    with Store.open(url) as store:
        launch, claims = begin(store, *specs)
        pairs = zip(claims, specs, strict=True)
        store.commit_many([(claim, make(spec), RUN) for claim, spec in pairs])
        store.end_launch(launch, "done", exit_code=0)


ALL = (
    "SELECT c.config_key, r.trial_key, r.seed, r.status, r.attempt, r.n_steps, r.final_loss, "
    "r.best_loss, r.diverged_at, r.wall_seconds, r.node, l.token, e.hash FROM trial r "
    "JOIN config c ON c.config_id = r.config_id "
    "LEFT JOIN launch l ON l.launch_id = r.launch_id LEFT JOIN error e ON e.error_id = r.error_id",
    "SELECT r.trial_key, s.t, s.loss, s.reachable_loss, s.plan_us, s.learn_us, s.evaluate_us "
    "FROM step s JOIN trial r ON r.trial_id = s.trial_id",
    "SELECT r.trial_key, p.dtype, p.states_shape, p.states, p.inputs_shape, p.inputs, "
    "p.parameters_shape, p.parameters FROM trajectory p JOIN trial r ON r.trial_id = p.trial_id",
    "SELECT r.trial_key, a.attempt, a.outcome, a.cause, a.node, a.pid, a.claimed, a.started, "
    "a.ended, a.wall_seconds, l.token, e.hash FROM attempt a "
    "JOIN trial r ON r.trial_id = a.trial_id JOIN launch l ON l.launch_id = a.launch_id "
    "LEFT JOIN error e ON e.error_id = a.error_id",
    "SELECT token, state, started, ended, host, pid, argv, overrides, git_commit, git_dirty, "
    "versions, exit_code FROM launch",
    "SELECT config_key, env, policy, model, learner, width, depth, horizon, dt, gamma, config_json "
    "FROM config",
    "SELECT hash, type, message, traceback FROM error",
    "SELECT r.trial_key, b.t, b.measure, b.value FROM assessment b "
    "JOIN trial r ON r.trial_id = b.trial_id",
    "SELECT r.trial_key, p.attempt - r.attempt, p.loss, p.reachable_loss, p.plan_us, p.learn_us, "
    "p.evaluate_us FROM curve p JOIN trial r ON r.trial_id = p.trial_id",
)


def everything(url: str) -> list[list[str]]:
    """Return all that is in a database, without the numbers that it gave itself."""
    with Reader.open(url) as reader:
        return [sorted(repr(_plain(row)) for row in reader.rows(sql)) for sql in ALL]


def _plain(row: tuple[object, ...]) -> list[object]:
    return [bytes(x) if isinstance(x, memoryview) else x for x in row]
