"""What a trial's specification means to the compiled loop: constants, first state, empty record."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np

from dopt.cell import Cell
from dopt.information import Information, held_information
from dopt.kernel import arguments as args
from dopt.kernel.information import PENDING_ROWS, SMALL
from dopt.kernel.points import evaluation_points
from dopt.learning import Adam, AdamReplay, AdamRule, ExtendedKalman, Learner
from dopt.models import MLP
from dopt.models.base import Model
from dopt.planning.task_states import task_states
from dopt.policies import (
    DOptimal,
    EOptimal,
    Informed,
    Lookahead,
    Search,
    TaskOptimal,
    TraceLinearized,
    Uniform,
)
from dopt.policies.base import OpenLoop
from dopt.policies.d_optimal import count_sketch
from dopt.policies.search import SCORES
from dopt.spec import TrialSpec
from dopt.systems.base import System
from dopt.systems.features import KINDS


@functools.lru_cache(maxsize=64)
def constants(
    cell: Cell,
) -> tuple[args.World, args.Network, args.Rules, args.Evaluation]:
    """Return everything that the trials of a cell share."""
    system, network = cell.system, network_of(cell.system, cell.model)
    points = evaluation_points(system, network)
    return world_of(system), network, _rules(cell), points


def world_of(system: System) -> args.World:
    """Return the constants of a system."""
    return args.World(
        np.array(system.parameters),
        np.array(system.history),  # a copy: what came through Ray's memory cannot be written to
        np.array(system.linear_form),
        np.array(system.learned_rows),
        system.n_inputs,
        system.dt,
        system.gamma,
        system.state_limit,
    )


def network_of(system: System, model: Model) -> args.Network:
    """Return the architecture of a model on a system."""
    if isinstance(model, MLP):
        kind, sizes = args.MLP_MODEL, model.layer_sizes(system)
    else:
        kind, sizes = args.LINEAR_MODEL, (len(system.features), 1, system.n_learned)
    lengths = [(n_in + 1) * n_out for n_in, n_out in itertools.pairwise(sizes)]
    return args.Network(
        kind,
        np.array(sizes),
        np.cumsum([0, *lengths[:-1]]),
        np.array([KINDS.index(feature.kind) for feature in system.features]),
        np.array([feature.index for feature in system.features]),
        np.array(system.feature_scales),
    )


def _learner(cell: Cell) -> dict[str, Any]:
    """Return the fields of the rules that describe the learner."""
    learner = cell.learner
    kinds = {Adam: args.ADAM, AdamReplay: args.REPLAY, ExtendedKalman: args.KALMAN}
    kind = next((k for cls, k in kinds.items() if isinstance(learner, cls)), args.LEAST_SQUARES)
    adam = learner if isinstance(learner, AdamRule) else Adam()
    kalman = learner if isinstance(learner, ExtendedKalman) else ExtendedKalman()
    replay = learner if isinstance(learner, AdamReplay) else None
    window = _window(learner, cell.system.horizon)
    renewed, renewal = kalman.renewal(cell.model.n_parameters(cell.system), _regularization(cell))
    return {
        "learner": kind,
        "learning_rate": adam.learning_rate,
        "beta_1": adam.beta_1,
        "beta_2": adam.beta_2,
        "epsilon": adam.epsilon,
        "window": max(1, window),
        "batch": replay.batch if replay else max(1, window),
        "steps": replay.steps if replay else 1,
        "noise_variance": kalman.noise_variance,
        "forgetting": kalman.forgetting,
        "renewed": renewed,
        "renewal": renewal,
    }


def _window(learner: Learner, horizon: int) -> int:
    """Return the number of samples that are kept."""
    if isinstance(learner, AdamReplay):
        return min(learner.capacity, horizon)
    return learner.window if isinstance(learner, Adam) else 0


def _rules(cell: Cell) -> args.Rules:
    policies = {
        OpenLoop: args.OPEN_LOOP,
        Uniform: args.UNIFORM,
        DOptimal: args.D_OPTIMAL,
        Search: args.SEARCH,
    }
    policy = next(code for kind, code in policies.items() if isinstance(cell.policy, kind))
    steps = cell.policy.iterations if isinstance(cell.policy, Uniform) else 0
    return args.Rules(
        policy,
        isinstance(cell.policy, TraceLinearized),
        _search(cell),
        steps,
        **_learner(cell),
        informed=isinstance(cell.policy, Informed),
        form=_form(cell),
        regularization=_regularization(cell),
    )


def _search(cell: Cell) -> args.Search:
    """Return the plans of a policy that searches."""
    policy, system, q = cell.policy, cell.system, cell.model.n_parameters(cell.system)
    steps, score = 0, args.JOINT
    candidates = np.zeros((0, system.n_inputs))
    if isinstance(policy, Search):
        steps, score = policy.steps(system), SCORES.index(policy.score)
        candidates = policy.compared_inputs(system)
    states = np.zeros((0, system.n_states))
    if isinstance(policy, TaskOptimal):
        states = task_states(system, policy)
    return args.Search(
        candidates,
        score,
        steps,
        steps // 2 if steps > 1 else steps,
        policy.stride_of(system) if isinstance(policy, Lookahead) else 1,
        policy.budget_us if isinstance(policy, Search) else 0.0,
        states,
        policy.starts(q, system.n_learned) if isinstance(policy, EOptimal) else np.zeros((0, q)),
        policy.subspace if isinstance(policy, EOptimal) else 0,
    )


def _regularization(cell: Cell) -> float:
    """Return λ of M₀ = λI, 1 where there is no M."""
    held = _held(cell)
    return held.regularization if held else 1.0


def _held(cell: Cell) -> Information | None:
    q, n_rows = cell.model.n_parameters(cell.system), cell.system.n_learned * cell.system.horizon
    return held_information(cell.policy, cell.learner, q, n_rows)


def initial_state(spec: TrialSpec, weights: np.ndarray[Any, Any]) -> args.State:
    system = spec.system
    window = _window(spec.learner, system.horizon)
    return args.State(
        weights.copy(),
        np.zeros(len(weights)),
        np.zeros(len(weights)),
        *_information(spec, len(weights)),
        np.zeros((len(system.features), window)),
        np.zeros((system.n_learned, window)),
    )


def _information(spec: TrialSpec, q: int) -> tuple[args.Covariance, args.Dual, args.Sketch]:
    """Return the initial information in the chosen form; the other forms are empty."""
    policy = spec.policy
    form = _form(spec.cell)
    size, dual, sketch = 0, _empty_dual(spec, 0), count_sketch(0, 1)
    if form == args.PRIMAL and _held(spec.cell):
        size = q
    elif form == args.DUAL:
        dual = _empty_dual(spec, spec.system.horizon)
    elif form == args.SKETCH and isinstance(policy, DOptimal):
        size = policy.sketch_size
        sketch = count_sketch(q, size)
    covariance = args.Covariance(
        np.eye(size) / _regularization(spec.cell),
        np.zeros((PENDING_ROWS if size > SMALL else 4, size)),
        np.zeros(1, dtype=np.int64),
    )
    return covariance, dual, args.Sketch(*sketch, size)


def _empty_dual(spec: TrialSpec, states: int) -> args.Dual:
    depth, width, r = 1, 1, spec.system.n_learned
    if isinstance(spec.model, MLP):
        depth, width = spec.model.depth, spec.model.width
    return args.Dual(
        np.empty((states, len(spec.system.features))),
        np.empty((depth, states, width)),
        np.empty((r, depth, states, width)),
        np.empty((r * states, r * states)),
        np.zeros(1, dtype=np.int64),
    )


def _form(cell: Cell) -> int:
    """Return the form of the information matrix, PRIMAL where there is none."""
    held = _held(cell)
    names = {"primal": args.PRIMAL, "dual": args.DUAL, "sketch": args.SKETCH}
    return names[held.form] if held else args.PRIMAL


def empty_record(system: System) -> args.Record:
    steps = system.horizon
    states = np.full((steps + 1, system.n_states), np.nan)
    states[0] = system.initial_state
    rows = (np.full(steps, np.nan) for _ in range(5))
    return args.Record(states, np.zeros((steps, system.n_inputs)), *rows)
