"""Translation of a trial's specification to structures: constants, first state, empty record."""

from __future__ import annotations

import functools

import numpy as np

from dopt.algorithm import Form, Integrator, Score, switch_step
from dopt.kernel import structs as args
from dopt.kernel.equations import compiled_equations
from dopt.kernel.evaluation_points import evaluation_points
from dopt.kernel.information import absent, dual, fresh, primal_linear, primal_network, sketch
from dopt.kernel.information.primal import PENDING_ROWS, SMALL
from dopt.kernel.model_from_spec import members_of, network_of, network_of_trial
from dopt.learning import GaussNewton, Learner
from dopt.limits import Limits
from dopt.models import MLP, GaussianProcess
from dopt.policies import (
    ICEM,
    DOptimal,
    EOptimal,
    InformationPolicy,
    Lookahead,
    Search,
    TaskOptimal,
)
from dopt.policies.d_optimal import count_sketch
from dopt.policies.held_candidates import HeldCandidates
from dopt.policies.search import score_code
from dopt.policies.task_states import box_states, domain_box, task_states
from dopt.randomness import Draws
from dopt.spec.config import TrialConfig
from dopt.spec.information_form import Information, held_information, is_fresh
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.systems.sensors import delay, differentiated
from dopt.types import Matrix, Vector

MODULES = {Form.PRIMAL: primal_network, Form.DUAL: dual, Form.SKETCH: sketch}


@functools.lru_cache(maxsize=64)
def constants(config: TrialConfig) -> tuple[args.Plant, args.Network, args.Algorithm]:
    """Return what the trials of a configuration share, but for their evaluation points."""
    network = network_of(config.system, config.model)
    return plant_of(config.system), network, algorithm_of(config)


@functools.lru_cache(maxsize=64)
def shared_points(config: TrialConfig) -> args.Evaluation:
    """Return the evaluation points of a configuration."""
    return evaluation_points(config.system, config.model, constants(config)[1])


def trial_of(spec: TrialSpec, draws: Draws) -> args.Trial:
    """Return all that a trial works on, before its first step."""
    plant, network, algorithm = constants(spec.config)
    network = network_of_trial(spec, network, draws.weights)
    record = empty_record(spec.system)
    return args.Trial(
        plant,
        network,
        algorithm,
        information_of(spec.config),
        limits_of(spec.config),
        sensors_of(spec.config),
        randomness_of(spec, draws),
        initial_state(spec, draws.weights, record),
        empty_scratch(spec, network),
        record,
    )


def plant_of(system: System) -> args.Plant:
    """Return the constants of a system."""
    return args.Plant(
        *compiled_equations(system),
        np.array(system.parameters),
        np.array(system.history),  # a copy: what came through Ray's memory cannot be written to
        np.array(system.linear_form),
        np.array(system.learned_rows),
        system.n_inputs,
        system.n_inputs if system.reads_inputs else 0,
        system.dt,
        system.gamma,
        system.state_limit,
        int(Integrator[system.integrator.upper()]),
    )


def algorithm_of(config: TrialConfig) -> args.Algorithm:
    """Return the settings of the policy and the learner of a configuration."""
    q, policy, learner = _n_learned(config), config.policy, config.learner
    regularization = _regularization(config)
    return args.Algorithm(
        np.array(policy.kernel_numbers(q, regularization)),
        np.array(learner.kernel_numbers(q, regularization)),
        _search(config),
    )


def information_of(config: TrialConfig) -> args.Information:
    """Return the functions for the form that holds M, which are compiled when a trial runs."""
    if not isinstance(config.policy, InformationPolicy):
        return args.Information(absent.add_rows, absent.planning_forms)
    linear = config.model.structure == "least_squares"
    module = primal_linear if linear else MODULES[Form(_form(config))]
    if is_fresh(config.policy):
        module = fresh  # which goes with a network and the primal form
    searches = isinstance(config.policy, (Search, ICEM))
    return args.Information(
        absent.add_rows if config.learner.updates_information else module.add_rows,
        absent.planning_forms if searches else module.planning_forms,
    )


def _search(config: TrialConfig) -> args.Search:
    """Return the plans of a policy that searches."""
    policy, system, q = config.policy, config.system, _n_learned(config)
    steps, score, held = 0, Score.JOINT, _held(config)
    candidates = np.zeros((0, system.n_inputs))
    if isinstance(policy, Search):
        steps, score = policy.steps(system), score_code(policy)
        candidates = policy.compared_inputs(system)
    elif isinstance(policy, HeldCandidates):
        steps, candidates = policy.lookahead, policy.compared_inputs(system)
    states = np.zeros((0, system.n_states))
    if isinstance(policy, TaskOptimal):
        states = task_states(system, policy)
    if isinstance(policy, ICEM) and policy.task_count:
        states = box_states(system)
    return args.Search(
        candidates,
        int(score),
        steps,
        switch_step(steps),
        policy.stride_of(system) if isinstance(policy, Lookahead) else 1,
        policy.budget_us if isinstance(policy, Search) else 0.0,
        states,
        domain_box(system, policy.domain) if isinstance(policy, ICEM) else np.zeros((2, 0)),
        policy.starts(q, system.n_learned) if isinstance(policy, EOptimal) else np.zeros((0, q)),
        policy.subspace if isinstance(policy, EOptimal) else 0,
        held.noise_variance**-0.5 if held else 1.0,
    )


def _regularization(config: TrialConfig) -> float:
    """Return λ of M₀ = λI, 1 where there is no M."""
    held = _held(config)
    return held.regularization if held else 1.0


def _n_learned(config: TrialConfig) -> int:
    """Return the number of parameters that are learned, the first ones."""
    model, system = config.model, config.system
    return model.n_member_parameters(system) - model.n_fixed_parameters(system)


def _held(config: TrialConfig) -> Information | None:
    q, n_rows = (
        config.model.n_member_parameters(config.system),
        config.system.n_learned * config.system.horizon,
    )
    return held_information(config.policy, config.learner, q, n_rows)


def initial_state(spec: TrialSpec, weights: Vector, record: args.Record) -> args.State:
    """Return the state of a trial before its first step.

    ``weights`` are all initial parameters of the model; the state holds those that are learned.
    """
    system, q = spec.system, _n_learned(spec.config)
    window = spec.learner.samples_kept(system.horizon)
    return args.State(
        weights[:q].copy(),
        weights[:q].copy(),
        members_of(spec.model, weights),
        np.zeros(q),
        np.zeros(q),
        *_information(spec, q),
        _visited(spec),
        _posterior(spec),
        _prediction_error(spec),
        _estimate(spec, q, record.inputs),
        np.zeros((len(spec.model.features(system)), window)),
        np.zeros((system.n_learned, window)),
        *(np.zeros(part.memory_size(system, q)) for part in (spec.policy, spec.learner)),
    )


def empty_scratch(spec: TrialSpec, network: args.Network) -> args.Scratch:
    """Return the memory that a learning step overwrites, for the largest batch of the learner."""
    room = int(max(network.sizes[1], spec.system.n_learned)) * spec.learner.largest_batch()
    depth, q = len(network.offsets) - 1, _n_learned(spec.config)
    return args.Scratch(np.empty((depth, room)), np.empty((3, room)), np.empty(q))


def _information(spec: TrialSpec, q: int) -> tuple[args.Covariance, Matrix, args.Dual, args.Sketch]:
    """Return the initial information in the chosen form; the other forms are empty."""
    policy = spec.policy
    form = _form(spec.config)
    size, rows, projection = 0, _empty_dual(spec, 0), count_sketch(0, 1)
    factored = q if isinstance(policy, ICEM) and _is_fitted(spec.learner) else 0
    if form == Form.PRIMAL and _needs_inverse(spec.config):
        size = q
    elif form == Form.DUAL:
        rows = _empty_dual(spec, spec.system.horizon)
    elif form == Form.SKETCH and isinstance(policy, DOptimal):
        size = policy.sketch_size
        projection = count_sketch(q, size)
    covariance = args.Covariance(
        np.eye(size) / _regularization(spec.config),
        np.zeros((PENDING_ROWS if size > SMALL else 4, size)),
        np.zeros(1, dtype=np.int64),
    )
    factor = np.eye(factored) * _regularization(spec.config) ** 0.5
    return covariance, factor, rows, args.Sketch(*projection, size)


def _needs_inverse(config: TrialConfig) -> bool:
    """Tell whether the policy or the learner reads M⁻¹: a learner that fits M anew may not."""
    policy = config.policy
    reads = isinstance(policy, InformationPolicy) and not isinstance(policy, ICEM)
    return _held(config) is not None and (reads or not _is_fitted(config.learner))


def _is_fitted(learner: Learner) -> bool:
    """Tell whether a learner makes M anew at each step."""
    return isinstance(learner, GaussNewton) and learner.refit_every == 1


def _visited(spec: TrialSpec) -> args.Visited:
    """Return the empty store of states; it has no room where information is accumulated."""
    places, refresh_every = 0, 1
    if is_fresh(spec.policy):
        places, refresh_every = spec.system.horizon, spec.policy.refresh_every
    return args.Visited(
        np.empty((len(spec.model.features(spec.system)), places)),
        np.zeros(1, dtype=np.int64),
        refresh_every,
        _regularization(spec.config),
    )


def limits_of(config: TrialConfig) -> args.Limits:
    """Return the limits of a configuration; one without any has none."""
    system, limits = config.system, config.limits or Limits()
    lower, upper = (column.copy() for column in limits.of_states(system).T)
    input_lower, input_upper = (column.copy() for column in limits.of_inputs(system).T)
    bounded = bool(np.isfinite(lower).any() or np.isfinite(upper).any())
    return args.Limits(
        limits.enforced and config.limits is not None,
        lower,
        upper,
        input_lower,
        input_upper,
        limits.changes(system),
        limits.steps if bounded else 0,
        limits.margin,
    )


def _prediction_error(spec: TrialSpec) -> args.PredictionError:
    r, m = spec.system.n_learned, spec.system.n_inputs
    if not limits_of(spec.config).enforced:
        r = m = 0
    return args.PredictionError(np.zeros(r), np.zeros((2, r)), np.zeros(m))


def sensors_of(config: TrialConfig) -> args.Sensors:
    """Return what is measured of the states of a configuration; nothing where all are known."""
    system, estimates = config.system, config.learner.estimates_states
    return args.Sensors(
        np.array(system.measured_states, dtype=np.int64),
        np.array(system.measurement_noise, dtype=float) ** 2,
        np.array(differentiated(system) if system.n_measured else [], dtype=np.int64),
        0.0 if estimates else system.velocity_cutoff,
        delay(system) if system.n_measured and not estimates else 0.0,
        np.zeros(system.n_states),  # the initial state of a simulation is known
    )


def _estimate(spec: TrialSpec, q: int, applied: Matrix) -> args.Estimate:
    """Return what is remembered to estimate states, without room where they are known."""
    system, estimates = spec.system, spec.learner.estimates_states
    steps = system.horizon if system.n_measured else 0
    d = system.n_states if system.n_measured and estimates else 0
    starts = np.full((steps, system.n_states), np.nan)
    if steps and not isinstance(system, BlackBox):
        starts[0] = system.initial_state
    return args.Estimate(
        starts,
        np.full((steps, system.n_measured), np.nan),
        np.zeros(steps),
        np.zeros_like(applied) if steps and not estimates else applied,
        np.zeros((3, system.n_states)),
        np.zeros(system.n_inputs),
        np.zeros((d, d)),
        np.zeros((d, q)),
    )


def _posterior(spec: TrialSpec) -> args.Posterior:
    """Return the room for the samples of a Gaussian process, none in other models."""
    T = spec.system.horizon if isinstance(spec.model, GaussianProcess) else 0
    solved = np.zeros((T, spec.system.n_learned))
    return args.Posterior(np.zeros((T, T)), solved, np.zeros(1, dtype=np.int64))


def _empty_dual(spec: TrialSpec, states: int) -> args.Dual:
    depth, width, r = 1, 1, spec.system.n_learned
    if isinstance(spec.model, MLP):
        depth, width = spec.model.depth, spec.model.width
    return args.Dual(
        np.empty((states, len(spec.model.features(spec.system)))),
        np.empty((depth, states, width)),
        np.empty((r, depth, states, width)),
        np.empty((r * states, r * states)),
        np.zeros(1, dtype=np.int64),
        _regularization(spec.config),
    )


def _form(config: TrialConfig) -> int:
    """Return the form of the information matrix, PRIMAL where there is none."""
    held = _held(config)
    return int(Form[held.form.upper()] if held else Form.PRIMAL)


def randomness_of(spec: TrialSpec, draws: Draws) -> args.Randomness:
    """Return the numbers that a trial has drawn; draws of parameters are of the learned ones."""
    drawn = args.Randomness(*(getattr(draws, name) for name in args.Randomness._fields))
    return drawn._replace(parameters=drawn.parameters[: _n_learned(spec.config)])


def empty_record(system: System) -> args.Record:
    """Return the record of a trial before its first step."""
    steps = system.horizon
    states = np.full((steps + 1, system.n_states), np.nan)
    if not isinstance(system, BlackBox):  # which starts where it is measured
        states[0] = system.initial_state
    true_states = states.copy() if system.n_measured else states
    rows = (np.full(steps, np.nan) for _ in range(5))
    return args.Record(states, true_states, np.zeros((steps, system.n_inputs)), *rows)
