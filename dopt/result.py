"""Result of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from dopt.control.task import Feedback
from dopt.types import Array


class Assessment(NamedTuple):
    """Value of one measure after t explored steps.

    The measures and their meanings are :data:`dopt.assessment.MEASURES`; a value that is
    not finite stands for an overflow.
    """

    t: int
    measure: str
    value: float


@dataclass(frozen=True, eq=False)
class TrialResult:
    """Everything that is measured in one trial of T steps.

    d is the number of states, m of inputs, r of learned accelerations and q of parameters of the
    model. States, inputs and accelerations have the units that their system declares
    (``spec.system.state_labels``, ``input_labels``).

    Attributes
    ----------
    loss, reachable_loss : (T,)
        Model error after the learning step of time t, sqrt(mean ‖a_θ(x) - a(x)‖²), over the
        evaluation grid and over the reachable set, in the unit of the accelerations.
    plan_us, learn_us, evaluate_us : (T,)
        Time spent on planning (with the update of the information matrix), on learning and on the
        evaluation [µs].
    states : (T + 1, d)
        States x_0 ... x_T, of a simulation the true ones.
    inputs : (T, m)
        Inputs u_0 ... u_{T-1}.
    parameters : (q,)
        Parameters of the model at the end; ``spec.model.predict`` takes them.
    diverged_at : int or None
        First step at which the state left the system's limit or a number was not finite. All rows
        from there on are NaN.
    wall_seconds, cpu_seconds : float
        Duration of the exploration [s].
    estimated_states : (T + 1, d) or None
        Estimates by which policy and learner went, where states are measured with noise.
    checkpoints : mapping of int to (q,)
        Parameters of the model after the numbers of steps at which the trial is to be assessed, up
        to a divergence.
    feedbacks : mapping of int to Feedback
        At those steps, the law of feedback of a policy that learns a task.
    assessments : tuple of Assessment
        Assessments at those steps, and violations of limits; empty without a task and limits.
    """

    loss: Array
    reachable_loss: Array
    plan_us: Array
    learn_us: Array
    evaluate_us: Array
    states: Array
    inputs: Array
    parameters: Array
    diverged_at: int | None
    wall_seconds: float
    cpu_seconds: float
    estimated_states: Array | None = None
    checkpoints: Mapping[int, Array] = field(default_factory=dict)
    feedbacks: Mapping[int, Feedback] = field(default_factory=dict)
    assessments: tuple[Assessment, ...] = ()

    @property
    def diverged(self) -> bool:
        """Whether the trial ended before its horizon."""
        return self.diverged_at is not None

    @property
    def n_steps(self) -> int:
        """Number of steps with a finite loss."""
        return len(self.loss) if self.diverged_at is None else self.diverged_at

    @property
    def final_loss(self) -> float | None:
        """Loss after the last step; None where the trial diverged."""
        return None if self.diverged or not len(self.loss) else float(self.loss[-1])

    @property
    def best_loss(self) -> float | None:
        """Smallest loss of the trial; None where no step was finished."""
        return float(np.min(self.loss[: self.n_steps])) if self.n_steps else None
