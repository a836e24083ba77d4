"""Algorithm 1 in torch for the trials of one configuration, which take each step together."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from dopt.control.task import Feedback
from dopt.evaluation import evaluation_set
from dopt.reference.black_box import episodes_for, initial_states, stepped
from dopt.reference.dynamics import true_accelerations, true_next_states
from dopt.reference.gaussian_process import Posterior
from dopt.reference.models import BatchModel
from dopt.reference.recorded import Recorded
from dopt.reference.steps import BatchSteps
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from dopt.types import Array

COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")


class Lockstep(BatchSteps):
    """A batch of n trials of one configuration that take each step together.

    Parameters and errors are those of :class:`dopt.reference.state.BatchState`.
    """

    def __init__(
        self, specs: Sequence[TrialSpec], device: str = "cpu", module: nn.Module | None = None
    ) -> None:
        super().__init__(specs, device, module)
        self.episodes = episodes_for(self.specs)
        if self.episodes:
            self.states[:, 0] = initial_states(self.episodes)
        self.columns = {
            name: np.full((len(specs), self.system.horizon), np.nan) for name in COLUMNS
        }
        points = evaluation_set(self.system)
        self.visited, self.applied = self.tensor(points.states), self.tensor(points.inputs)
        self.truth, self.n_grid = self.tensor(points.accelerations), points.n_grid
        self.evaluated = self.points(self.visited, self.applied)
        self.prepare(self.evaluated)
        constant = functools.partial(true_next_states, self.system, 0)
        self._true_next_states = Recorded(constant)
        known = self.model, self.evaluated.unsqueeze(0), self.n_grid
        self._errors = Recorded(functools.partial(errors_of_model, *known))
        self.checkpoints: dict[int, Array] = {}
        self.feedbacks: dict[int, list[Feedback | None]] = {}

    def act(self, t: int, u: Tensor) -> None:
        """Apply u_t, store x_{t+1} (equation 2) and the observed accelerations."""
        x = self.true_states[:, t]
        if self.episodes:
            u, following = stepped(self.episodes, x, u)
        else:
            following = self._following(t, x, u) + self.noise[:, t]
        self.inputs[:, t] = u
        self.true_states[:, t + 1] = following
        if self.sensors:
            self.sensors.measure(t)
        self.observe(t, self.system.dt)

    def _following(self, t: int, x: Tensor, u: Tensor) -> Tensor:
        """Return the states that follow (n, d) under inputs (n, m), without noise."""
        if len(self.system.history) > 1:
            return true_next_states(self.system, t, x, u)
        following: Tensor = self._true_next_states(x, u)
        return following

    def evaluate(self, t: int) -> tuple[Tensor, Tensor]:
        """Return the RMS errors at step t over the grid and over the reachable set, (n,) each."""
        if len(self.system.history) > 1:
            self.truth = true_accelerations(self.system, self.visited, self.applied, t)
        if isinstance(self.learner, Posterior):
            return errors(self.learner.predict_points(), self.truth, self.n_grid)
        learned = self.theta if self.members is None else self.members
        found: tuple[Tensor, Tensor] = self._errors(learned, self.truth)
        return found

    def step(self, t: int) -> None:
        """Take step t of every trial and record it."""
        clocks = [self._clock()]
        u = self.plan(t)
        clocks.append(self._clock())
        self.act(t, u)
        inside = self.true_states[:, t + 1].abs() <= self.system.state_limit
        self.diverged |= ~inside.all(dim=1, keepdim=True)
        clocks.append(self._clock())
        self.learn(t)
        clocks.append(self._clock())
        self.inform(t)
        clocks.append(self._clock())
        loss, reachable = self.evaluate(t)
        self.diverged |= ~loss.isfinite().unsqueeze(1)
        clocks.append(self._clock())
        planned, _, learned, informed, evaluated = np.diff(clocks) * 1e6 / len(self.specs)
        self.columns["loss"][:, t] = loss.cpu().numpy()
        self.columns["reachable_loss"][:, t] = reachable.cpu().numpy()
        self.columns["plan_us"][:, t] = planned + informed
        self.columns["learn_us"][:, t] = learned
        self.columns["evaluate_us"][:, t] = evaluated

    def note_checkpoint(self, t: int) -> None:
        """Keep what has been learned after t steps, which is to be assessed."""
        self.checkpoints[t] = self.parameters_of_model.cpu().numpy().copy()
        self.feedbacks[t] = [planner.feedback() for planner in self.planners]

    def _clock(self) -> float:
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def errors_of_model(
    model: BatchModel, points: Tensor, n_grid: int, theta: Tensor, truth: Tensor
) -> tuple[Tensor, Tensor]:
    """Return :func:`errors` at points (1, N, ·) for θ (n, q), or (n, E, q) for networks' mean."""
    if theta.ndim == 2:
        return errors(model(theta, points), truth, n_grid)
    each = [model(member, points) for member in theta.unbind(1)]
    return errors(torch.stack(each).mean(dim=0), truth, n_grid)


def errors(predicted: Tensor, truth: Tensor, n_grid: int) -> tuple[Tensor, Tensor]:
    """Return the RMS errors of accelerations (n, N, r) at the first points and at the others."""
    squares = (predicted - truth).square().sum(dim=-1)
    grid, reachable = squares[:, :n_grid], squares[:, n_grid:]
    return grid.mean(dim=1).sqrt(), reachable.mean(dim=1).sqrt()


@torch.no_grad()
def run_trials(
    specs: Sequence[TrialSpec], device: str = "cpu", module: nn.Module | None = None
) -> list[TrialResult]:
    """Run trials of one configuration in lockstep; each result is that of the trial run alone.

    Parameters and errors are those of :class:`dopt.reference.state.BatchState`. The seconds and
    microseconds of a result are the batch's divided by its size.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    batch = Lockstep(specs, device, module)
    for t in range(batch.system.horizon + 1):
        if t in specs[0].assessed_steps:
            batch.note_checkpoint(t)
        if t < batch.system.horizon:
            batch.step(t)
    n = len(specs)
    seconds = ((time.perf_counter() - wall) / n, (time.process_time() - cpu) / n)
    return [_result(batch, i, *seconds) for i in range(n)]


def _result(batch: Lockstep, i: int, wall: float, cpu: float) -> TrialResult:
    """Cut trial i out of the batch; its rows end where it diverged."""
    states, inputs = batch.true_states[i].cpu().numpy(), batch.inputs[i].cpu().numpy()
    columns = {name: rows[i].copy() for name, rows in batch.columns.items()}
    inside = np.all(np.abs(states[1:]) <= batch.system.state_limit, axis=1)
    wrong = np.flatnonzero(~(inside & np.isfinite(columns["loss"])))
    end = int(wrong[0]) if len(wrong) else None
    if end is not None:
        for rows in (*columns.values(), inputs):
            rows[end:] = np.nan
        states[end:] = np.nan
    reached = [t for t in batch.checkpoints if end is None or t <= end]
    learned = {t: batch.feedbacks[t][i] for t in reached if batch.planners}
    estimated = batch.states[i].cpu().numpy() if batch.sensors else None
    if estimated is not None and end is not None:
        estimated[end:] = np.nan
    return TrialResult(
        **columns,
        states=states,
        inputs=inputs,
        parameters=batch.parameters_of_model[i].cpu().numpy().copy(),
        estimated_states=estimated,
        diverged_at=end,
        wall_seconds=wall,
        cpu_seconds=cpu,
        checkpoints={t: batch.checkpoints[t][i] for t in reached},
        feedbacks={t: feedback for t, feedback in learned.items() if feedback is not None},
    )
