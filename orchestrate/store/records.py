"""Values that a launch passes to the results database and gets back from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Registrable(Protocol):
    """Trial before it runs, such as :class:`dopt.spec.trial.TrialSpec`."""

    @property
    def trial_key(self) -> str: ...
    @property
    def config_key(self) -> str: ...
    @property
    def config_json(self) -> str: ...
    @property
    def seed(self) -> int: ...
    def columns(self) -> Mapping[str, Any]:
        """Values of env, policy, model, learner, width, depth, horizon, dt, gamma and label."""


class Measured(Protocol):
    """Measure of a trial after t steps."""

    @property
    def t(self) -> int: ...
    @property
    def measure(self) -> str: ...
    @property
    def value(self) -> float: ...


class Result(Protocol):
    """Result of a trial; :class:`dopt.result.TrialResult` describes the fields."""

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
    """Provenance of one launch.

    Attributes
    ----------
    argv, overrides
        The command line, and its overrides.
    git_commit, git_dirty, git_diff_hash
        Commit of the code, whether the working tree differs from it, and the hash of the
        difference; None outside a repository.
    versions
        Version of the interpreter and of each library that can change a number.
    fingerprint
        Digests of the code, and versions, with which alone a worker runs what this launch registers
        (:func:`orchestrate.fingerprint.fingerprint`); None if unknown.
    """

    argv: Sequence[str]
    overrides: Sequence[str]
    host: str
    pid: int
    git_commit: str | None = None
    git_dirty: bool | None = None
    git_diff_hash: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    fingerprint: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Claim:
    """Right of one launch to write the outcome of one attempt at one trial."""

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
        Distinct trials of the grid: the sum of the other numbers and of ``len(todo)``.
    todo
        Keys of the trials to run, in the given order.
    """

    total: int
    done: int
    diverged: int
    failed: int
    cancelled: int
    running_elsewhere: int
    todo: list[str]
