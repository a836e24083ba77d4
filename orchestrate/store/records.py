"""What a launch hands to the store, and what it gets back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Registrable(Protocol):
    """A trial before it runs; :class:`dopt.spec.TrialSpec` is one."""

    @property
    def trial_key(self) -> str: ...
    @property
    def config_key(self) -> str: ...
    @property
    def config_json(self) -> str: ...
    @property
    def seed(self) -> int: ...
    def columns(self) -> Mapping[str, Any]:
        """Values of env, policy, model, learner, width, depth, horizon, dt and gamma."""


class Measured(Protocol):
    """A number that says what a trial was worth after t steps."""

    @property
    def t(self) -> int: ...
    @property
    def measure(self) -> str: ...
    @property
    def value(self) -> float: ...


class Result(Protocol):
    """A trial after it ran; :class:`dopt.result.TrialResult` is one and explains the fields."""

    @property
    def loss(self) -> Array: ...
    @property
    def reachable_loss(self) -> Array: ...
    @property
    def plan_us(self) -> Array: ...
    @property
    def learn_us(self) -> Array: ...
    @property
    def evaluate_us(self) -> Array: ...
    @property
    def states(self) -> Array: ...
    @property
    def inputs(self) -> Array: ...
    @property
    def parameters(self) -> Array: ...
    @property
    def diverged_at(self) -> int | None: ...
    @property
    def n_steps(self) -> int: ...
    @property
    def final_loss(self) -> float | None: ...
    @property
    def best_loss(self) -> float | None: ...
    @property
    def assessments(self) -> Sequence[Measured]: ...


@dataclass(frozen=True)
class LaunchRecord:
    """Provenance of one command.

    Attributes
    ----------
    argv, overrides
        The command line, and the part of it that Hydra saw as overrides.
    git_commit, git_dirty, git_diff_hash
        Commit of the code, whether the working tree differed, and the hash of the difference;
        None outside a repository.
    versions
        Version of the interpreter and of each library that can change a number.
    """

    argv: Sequence[str]
    overrides: Sequence[str]
    host: str
    pid: int
    git_commit: str | None = None
    git_dirty: bool | None = None
    git_diff_hash: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RunRecord:
    """Where and how one attempt ran; ``started`` and ``ended`` carry a time zone."""

    node: str
    pid: int
    wall_seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    started: datetime
    ended: datetime


@dataclass(frozen=True)
class Failure:
    """Why an attempt failed; ``cause`` is the kind, such as "exception", "killed", "timeout"."""

    type: str
    message: str
    traceback: str
    cause: str = "exception"


@dataclass(frozen=True)
class Claim:
    """The right of one launch to write the outcome of one attempt of one trial."""

    trial_key: str
    trial_id: int
    attempt: int
    launch: int


@dataclass(frozen=True)
class Registration:
    """State of a grid at its registration.

    Attributes
    ----------
    total
        Distinct trials of the grid; the sum of all the other numbers and of ``len(todo)``.
    todo
        Keys of the trials that wait to be run, in the order in which they were given.
    """

    total: int
    done: int
    diverged: int
    failed: int
    cancelled: int
    running_elsewhere: int
    todo: list[str]
