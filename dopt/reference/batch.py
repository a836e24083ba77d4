"""Algorithm 1 in torch: the trials of one cell in lockstep, or a single one."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.func import jacrev, vmap

from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.information import held_information
from dopt.policies import DOptimal, Search, TraceLinearized, Uniform
from dopt.policies.base import OpenLoop
from dopt.policies.d_optimal import count_sketch
from dopt.randomness import draw
from dopt.reference.black_box import episodes_for, initial_states, stepped
from dopt.reference.dynamics import flow, known_flow, true_accelerations
from dopt.reference.gaussian_process import Posterior
from dopt.reference.learners import batch_learner
from dopt.reference.learning import KalmanLearner
from dopt.reference.models import model_function, network_function
from dopt.reference.own import observe, planned_inputs, planners_for
from dopt.reference.planning import d_optimal_inputs, quadratic_problem, summed, uniform_inputs
from dopt.reference.plans import plan_for
from dopt.reference.search import searched_inputs
from dopt.result import TrialResult
from dopt.spec import TrialSpec

Array = npt.NDArray[np.float64]

COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")


class Lockstep:
    """A batch of n trials of one cell that take each step together.

    Parameters
    ----------
    specs : sequence of TrialSpec
        Trials that differ in the seed alone.
    device : str
        Torch device, ``"cpu"`` or ``"cuda"``.
    module : torch.nn.Module, optional
        Network from features to accelerations in place of the registered model; its parameters at
        the time of the call are the initial ones of every trial.

    Raises
    ------
    SpecificationError
        If the trials belong to different cells.
    """

    def __init__(
        self, specs: Sequence[TrialSpec], device: str = "cpu", module: nn.Module | None = None
    ) -> None:
        if len({spec.config_key for spec in specs}) != 1:
            raise SpecificationError(
                f"{len(specs)} trials of different configurations were given, but those of a "
                f"batch may differ in the seed alone: run one batch for each configuration."
            )
        self.specs, self.device = list(specs), device
        self.system, self.cell = specs[0].system, specs[0].cell
        draws = [draw(spec) for spec in specs]
        self.noise = self._tensor(np.stack([d.noise for d in draws]))
        self.open_loop = self._tensor(np.stack([d.inputs for d in draws]))
        self.ties = self._tensor(np.stack([d.ties for d in draws]))
        self.components = torch.tensor(np.stack([d.components for d in draws]), device=device)
        self.theta = self._tensor(np.stack([d.weights for d in draws]))
        self.model = model_function(self.system, self.cell.model)
        if module is not None:
            self.model = network_function(self.system, module)
            flat = nn.utils.parameters_to_vector(module.parameters()).detach().double()
            self.theta = flat.to(device).repeat(len(specs), 1)
        self.n_learned = self.theta.shape[1] - self.cell.model.n_fixed_parameters(self.system)
        q, n_rows = self.theta.shape[1], self.system.n_learned * self.system.horizon
        self.held = held_information(self.cell.policy, self.cell.learner, q, n_rows)
        self._allocate()
        self.planners = planners_for(self.specs)
        self.replay = torch.tensor(np.stack([d.replay for d in draws]), device=device)
        self.learner = batch_learner(self)
        self._rows = vmap(jacrev(self.model))
        self.own_plan = plan_for(self)

    def _tensor(self, values: npt.NDArray[np.float64]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=self.device)

    def _unset(self, *shape: int) -> Tensor:
        return torch.full(shape, torch.nan, dtype=torch.float64, device=self.device)

    def _allocate(self) -> None:
        n, T = len(self.specs), self.system.horizon
        self.states = self._unset(n, T + 1, self.system.n_states)
        self.episodes = episodes_for(self.specs)
        if self.episodes:
            self.states[:, 0] = initial_states(self.episodes)
        else:
            self.states[:, 0] = self._tensor(np.array(self.system.initial_state))
        self.diverged = torch.zeros(n, 1, dtype=torch.bool, device=self.device)
        self.inputs = self._unset(n, T, self.system.n_inputs)
        self.targets = self._unset(n, T, self.system.n_learned)
        self.project: Callable[[Tensor], Tensor] = lambda rows: rows[..., : self.n_learned]
        self.columns = {name: np.full((n, T), np.nan) for name in COLUMNS}
        self.information: Tensor | None = None
        if self.held:
            self._choose_form(self.held.form)
            size = self.project(self.theta).shape[1]
            prior = self.held.regularization * torch.eye(size).to(self.theta)
            self.information = prior.repeat(n, 1, 1)
        points = evaluation_set(self.system)
        self.points = self._tensor(points.states)
        self.truth = self._tensor(points.accelerations)
        self.n_grid = points.n_grid

    def _choose_form(self, form: str) -> None:
        """Plan in the space of a sketch where the specification says so.

        The dual form is an algorithm of the kernel for the same M; the reference builds M.
        """
        q, policy = self.theta.shape[1], self.cell.policy
        if self.cell.model.structure == "least_squares":
            return
        if form == "sketch":
            assert isinstance(policy, DOptimal)
            buckets, signs = count_sketch(q, policy.sketch_size)
            matrix = torch.zeros(q, policy.sketch_size).to(self.theta)
            matrix[torch.arange(q), torch.tensor(buckets)] = torch.tensor(signs).to(self.theta)
            self.project = lambda rows: rows @ matrix

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m); the first of a closed-loop policy is random."""
        policy, x = self.cell.policy, self.states[:, t]
        if isinstance(policy, OpenLoop) or t == 0:
            return self.open_loop[:, t]
        if self.planners:
            return planned_inputs(self, t)
        if self.own_plan is not None:
            return self.own_plan.plan(t)
        if isinstance(policy, Uniform):
            seen = self.states[:, : t + 1]
            return uniform_inputs(self.system, self.model, self.theta, seen, policy.iterations)
        assert self.information is not None
        given = (self.system, self.model, self.theta, self.information, x)
        if isinstance(policy, Search):
            return searched_inputs(policy, *given, self.ties[:, t])
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
        """Update the parameters with the samples up to time t; diverged trials keep theirs."""
        before = self.theta.clone()
        seen = (self.states[:, : t + 1], self.targets[:, : t + 1])
        if isinstance(self.learner, KalmanLearner):
            assert self.information is not None
            self.information = self.learner.filtered(*seen, self.information)
        else:
            self.learner.learn(*seen)
        self.theta.copy_(torch.where(self.diverged, before, self.theta))

    def rows(self, t: int) -> Tensor:
        """Return J at x_t and the current parameters, (n, r, s), in the space of M."""
        return self.project(self._rows(self.theta, self.states[:, t]))

    def inform(self, t: int) -> None:
        """Add JᵀJ at (x_t, u_t) and the parameters after the learning step of time t.

        A Kalman filter has done so in its learning step.
        """
        observe(self, t)
        if self.information is not None and not isinstance(self.learner, KalmanLearner):
            J = self.rows(t)
            self.information = self.information + J.mT @ J
        if self.own_plan is not None:
            self.own_plan.inform(t)

    def evaluate(self, t: int) -> tuple[Tensor, Tensor]:
        """Return the L2 errors at step t over the grid and over the reachable set, (n,) each."""
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
        predicted: Tensor = vmap(over_points, in_dims=(0, None))(self.theta, self.points)
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
    """Run trials of one cell in lockstep; each result is that of the trial run alone.

    Parameters and errors are those of :class:`Lockstep`. The seconds and microseconds of a result
    are the batch's divided by its size.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    batch = Lockstep(specs, device, module)
    checkpoints = {}
    for t in range(batch.system.horizon + 1):
        if t in specs[0].assessed_steps:
            checkpoints[t] = batch.theta.cpu().numpy().copy()
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
        parameters=batch.theta[i].cpu().numpy().copy(),
        diverged_at=end,
        wall_seconds=wall,
        cpu_seconds=cpu,
        checkpoints={t: theta[i] for t, theta in checkpoints.items() if end is None or t <= end},
    )
