"""Algorithm 1 in torch for the trials of one configuration, which take each step together."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import jacrev, vmap

from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.policies import DOptimal, Search, TraceLinearized, Uniform
from dopt.policies.base import OpenLoop
from dopt.reference.black_box import episodes_for, initial_states, stepped
from dopt.reference.custom_plugins import observe, planned_inputs, planners_for
from dopt.reference.dynamics import flow, known_flow, true_accelerations
from dopt.reference.gaussian_process import Posterior
from dopt.reference.learner_registry import batch_learner
from dopt.reference.learning import GaussNewtonLearner, KalmanLearner
from dopt.reference.planner_registry import plan_for
from dopt.reference.planning import d_optimal_inputs, quadratic_problem, summed, uniform_inputs
from dopt.reference.search import searched_inputs
from dopt.reference.state import BatchState
from dopt.result import TrialResult
from dopt.spec.information_form import is_fresh
from dopt.spec.trial import TrialSpec
from dopt.types import Array

COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")


class Lockstep(BatchState):
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
        self.points, self.truth = self.tensor(points.states), self.tensor(points.accelerations)
        self.n_grid = points.n_grid
        self.planners = planners_for(self.specs)
        self.learner = batch_learner(self, self.points)
        self.own_plan = plan_for(self, self.learner)
        self._rows = vmap(jacrev(self.model))

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m); the first of a closed-loop policy is random."""
        policy, x = self.config.policy, self.states[:, t]
        if isinstance(policy, OpenLoop) or t == 0:
            return self.open_loop[:, t]
        if self.planners:
            return planned_inputs(self, self.planners, t)
        if self.own_plan is not None:
            return self.own_plan.plan(t)
        if isinstance(policy, Uniform):
            seen = self.states[:, : t + 1]
            return uniform_inputs(self.system, self.model, self.theta, seen, policy.iterations)
        if self.information is None or not isinstance(policy, (Search, DOptimal)):
            raise SpecificationError(
                f"the reference has no plan for policy '{policy.name}': derive its class from "
                f"CustomPolicy, or enter a plan in dopt.reference.planner_registry."
            )
        given = (self.system, self.model, self.theta, self.information, x)
        if isinstance(policy, Search):
            assert self.held is not None
            return searched_inputs(policy, *given, self.ties[:, t], self.held.noise_variance)
        components = self.components[:, t : t + 1]
        if isinstance(policy, TraceLinearized):
            components = torch.arange(self.system.n_learned).to(components).expand(len(x), -1)
        problems = [quadratic_problem(*given, k, self.project) for k in components.unbind(1)]
        return d_optimal_inputs(summed(problems), self.system.gamma, self.ties[:, t])

    def act(self, t: int, u: Tensor) -> None:
        """Apply u_t, store x_{t+1} (equation 2) and the observed accelerations."""
        x = self.states[:, t]
        if self.episodes:
            u, following = stepped(self.episodes, u)
        else:
            step = flow(self.system, x, u, true_accelerations(self.system, x, t))
            following = x + self.system.dt * step + self.noise[:, t]
        observed = (following - x) / self.system.dt - known_flow(self.system, x, u)
        self.inputs[:, t] = u
        self.states[:, t + 1] = following
        self.targets[:, t] = observed[:, list(self.system.learned_rows)]

    def learn(self, t: int) -> None:
        """Update the parameters with the samples up to time t; diverged trials keep theirs.

        Of an ensemble that is the member whose turn it is, and then the first one, whose M stays.
        """
        if self.members is None:
            self._learn(t)
            return
        assert isinstance(self.learner, GaussNewtonLearner)
        for turn in (1 + t % (self.members.shape[1] - 1), 0):
            self.theta.copy_(self.members[:, turn])
            self.learner.prior.copy_(self.member_priors[:, turn])
            self._learn(t)
            self.members[:, turn] = self.theta

    def _learn(self, t: int) -> None:
        before = self.theta.clone()
        seen = (self.states[:, : t + 1], self.targets[:, : t + 1])
        if isinstance(self.learner, KalmanLearner):
            assert self.information is not None
            self.information = self.learner.filtered(*seen, self.information)
        else:
            self.learner.learn(*seen)
        self.theta.copy_(torch.where(self.diverged, before, self.theta))

    @property
    def parameters_of_model(self) -> Tensor:
        """Parameters of the model, (n, q), those of the members one after the other."""
        return self.theta if self.members is None else self.members.flatten(1)

    def rows(self, t: int) -> Tensor:
        """Return J at x_t and the current parameters, (n, r, s), in the space of M."""
        return self.project(self._rows(self.theta, self.states[:, t]))

    def inform(self, t: int) -> None:
        """Add JᵀJ at (x_t, u_t) and the parameters after the learning step of time t.

        A learner that shares M has done so in its learning step. Fresh information has the rows of
        all states at these parameters instead.
        """
        observe(self, self.planners, t)
        if self.information is not None and not isinstance(self.learner, KalmanLearner):
            self.information = self._informed(self.information, t)
        if self.own_plan is not None:
            self.own_plan.inform(t)

    def _informed(self, information: Tensor, t: int) -> Tensor:
        """Return M after step t: with the rows at x_t, or fresh, with those of all states."""
        policy = self.config.policy
        if is_fresh(policy) and (t + 1) % policy.refresh_every == 0:
            return self._summed_anew(t)
        J = self.rows(t)
        return information + J.mT @ J

    def _summed_anew(self, t: int) -> Tensor:
        """Return λI + Σ JᵀJ over x_0 ... x_t at the current parameters.

        θ is NaN afterwards, which ends the trial as diverged, where rounding has left the sum
        indefinite or its inverse is not finite.
        """
        assert self.held is not None
        over_states = vmap(self._rows, in_dims=(None, 1), out_dims=1)
        J = self.project(over_states(self.theta, self.states[:, : t + 1])).flatten(1, 2)
        total: Tensor = self.held.regularization * torch.eye(J.shape[-1]).to(J) + J.mT @ J
        factor, failed = torch.linalg.cholesky_ex(total)
        root = torch.linalg.solve_triangular(factor, torch.eye(J.shape[-1]).to(J), upper=False)
        lost = (failed > 0) | ~root.square().sum(dim=1).isfinite().all(dim=1)
        self.theta.masked_fill_(lost.unsqueeze(1) & ~self.diverged, torch.nan)
        return total

    def evaluate(self, t: int) -> tuple[Tensor, Tensor]:
        """Return the RMS errors at step t over the grid and over the reachable set, (n,) each."""
        if len(self.system.history) > 1:
            self.truth = true_accelerations(self.system, self.points, t)
        squares = (self._predicted() - self.truth).square().sum(dim=-1)
        grid, reachable = squares[:, : self.n_grid], squares[:, self.n_grid :]
        return grid.mean(dim=1).sqrt(), reachable.mean(dim=1).sqrt()

    def _predicted(self) -> Tensor:
        """Return the modelled accelerations at the evaluation points, (n, N, r)."""
        if isinstance(self.learner, Posterior):
            return self.learner.predict_points()
        over_points = vmap(self.model, in_dims=(None, 0))
        over_trials = vmap(over_points, in_dims=(0, None))
        if self.members is not None:
            members = self.members.unbind(1)
            return torch.stack([over_trials(theta, self.points) for theta in members]).mean(dim=0)
        predicted: Tensor = over_trials(self.theta, self.points)
        return predicted

    def step(self, t: int) -> None:
        """Take step t of every trial and record it."""
        clocks = [self._clock()]
        u = self.plan(t)
        clocks.append(self._clock())
        self.act(t, u)
        inside = self.states[:, t + 1].abs() <= self.system.state_limit
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

    def _clock(self) -> float:
        if self.device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()


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
    checkpoints = {}
    for t in range(batch.system.horizon + 1):
        if t in specs[0].assessed_steps:
            checkpoints[t] = batch.parameters_of_model.cpu().numpy().copy()
        if t < batch.system.horizon:
            batch.step(t)
    n = len(specs)
    seconds = ((time.perf_counter() - wall) / n, (time.process_time() - cpu) / n)
    return [_result(batch, i, checkpoints, *seconds) for i in range(n)]


def _result(
    batch: Lockstep, i: int, checkpoints: Mapping[int, Array], wall: float, cpu: float
) -> TrialResult:
    """Cut trial i out of the batch; its rows end where it diverged."""
    states, inputs = batch.states[i].cpu().numpy(), batch.inputs[i].cpu().numpy()
    columns = {name: rows[i].copy() for name, rows in batch.columns.items()}
    inside = np.all(np.abs(states[1:]) <= batch.system.state_limit, axis=1)
    wrong = np.flatnonzero(~(inside & np.isfinite(columns["loss"])))
    end = int(wrong[0]) if len(wrong) else None
    if end is not None:
        for rows in (*columns.values(), inputs):
            rows[end:] = np.nan
        states[end:] = np.nan
    return TrialResult(
        **columns,
        states=states,
        inputs=inputs,
        parameters=batch.parameters_of_model[i].cpu().numpy().copy(),
        diverged_at=end,
        wall_seconds=wall,
        cpu_seconds=cpu,
        checkpoints={t: theta[i] for t, theta in checkpoints.items() if end is None or t <= end},
    )
