"""What a trial's specification means to the compiled loop: constants, first state, empty record."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np

from dopt.evaluation import EvaluationSet, evaluation_set
from dopt.information import Information, held_information
from dopt.kernel import arguments as args
from dopt.kernel.evaluation import BLOCK
from dopt.kernel.information import PENDING_ROWS, SMALL
from dopt.learning import Adam, AdamReplay, AdamRule, ExtendedKalman, Learner
from dopt.models import MLP
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
from dopt.spec import Cell, TrialSpec
from dopt.systems.base import System
from dopt.systems.features import KINDS


@functools.lru_cache(maxsize=64)
def constants(
    cell: Cell,
) -> tuple[args.World, args.Network, args.Rules, args.Evaluation]:
    """Return everything that the trials of a cell share."""
    system = cell.system
    world = args.World(
        np.array(system.parameters),
        np.array(system.history),  # a copy: what came through Ray's memory cannot be written to
        np.array(system.linear_form),
        np.array(system.learned_rows),
        system.n_inputs,
        system.dt,
        system.gamma,
        system.state_limit,
    )
    network = _network(cell)
    return world, network, _rules(cell), _evaluation(system, network, evaluation_set(system))


def _network(cell: Cell) -> args.Network:
    system = cell.system
    if isinstance(cell.model, MLP):
        kind, sizes = args.MLP_MODEL, cell.model.layer_sizes(system)
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
        candidates = policy.candidates(system)
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


def _evaluation(system: System, network: args.Network, points: EvaluationSet) -> args.Evaluation:
    if network.kind == args.LINEAR_MODEL:
        return _linear_evaluation(system, points)
    columns = [system.featurize(points.states).T, points.accelerations.T]
    parts = [slice(0, points.n_grid), slice(points.n_grid, None)]
    features, targets, sizes = zip(
        *(_blocks(columns[0][:, part], columns[1][:, part]) for part in parts), strict=True
    )
    blocks = np.concatenate(features)
    return args.Evaluation(
        blocks.astype(np.float32),
        blocks,
        np.concatenate(targets),
        np.concatenate(sizes),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0)),
        _followed(system, points),
        len(sizes[0]),
        len(sizes[0]) + len(sizes[1]),
        _size(system, points),
    )


def _followed(system: System, points: EvaluationSet) -> args.Floats:
    """Return the states at which the truth is evaluated anew at each step."""
    return points.states if len(system.history) > 1 else points.states[:0]


def own_targets(points: args.Evaluation) -> args.Evaluation:
    """Return points whose targets a trial may write into, if the truth changes with time."""
    if not len(points.states):
        return points
    return points._replace(block_targets=points.block_targets.copy(), targets=points.targets.copy())


def _blocks(features: args.Floats, targets: args.Floats) -> tuple[Any, Any, Any]:
    """Cut columns of points, (·, N), into padded blocks, (blocks, ·, BLOCK), and their sizes."""
    n = features.shape[1]
    starts = range(0, n, BLOCK)
    sizes = np.array([min(BLOCK, n - start) for start in starts], dtype=np.int64)

    def cut(columns: args.Floats) -> args.Floats:
        padded = np.zeros((len(columns), BLOCK * len(starts)))
        padded[:, :n] = columns
        return np.ascontiguousarray(padded.reshape(len(columns), -1, BLOCK).swapaxes(0, 1))

    return cut(features), cut(targets), sizes


def _linear_evaluation(system: System, points: EvaluationSet) -> args.Evaluation:
    offset, *units = (
        np.stack(np.broadcast_arrays(*system.accelerations(tuple(points.states.T), form)), axis=-1)
        for form in system.linear_form
    )
    regressors = np.stack([unit - offset for unit in units], axis=-1)
    return args.Evaluation(
        np.zeros((0, 0, 0), dtype=np.float32),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0, 0)),
        np.zeros(0, dtype=np.int64),
        np.ascontiguousarray(regressors),
        np.ascontiguousarray(points.accelerations - offset),
        _followed(system, points),
        points.n_grid,
        len(points.states),
        _size(system, points),
    )


def _size(system: System, points: EvaluationSet) -> float:
    """Return the root mean square norm of the targets, at the first or the last step."""
    ends = (points.accelerations, system.learned(points.states, system.horizon - 1))
    return max(float(np.sqrt(np.mean(np.sum(targets**2, axis=1)))) for targets in ends)


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
    states = np.zeros((steps + 1, system.n_states))
    states[0] = system.initial_state
    rows = (np.full(steps, np.nan) for _ in range(5))
    return args.Record(states, np.zeros((steps, system.n_inputs)), *rows)
