"""Translation of a specification to the structures of its trial, and what its steps write."""

from __future__ import annotations

import functools

import numpy as np

from dopt.algorithm import FeatureKind, Form, Integrator, ModelKind
from dopt.errors import SpecificationError
from dopt.evaluation import EvaluationSet, box_states, domain_box, evaluation_set, task_states
from dopt.kernel import information
from dopt.kernel import structs as args
from dopt.kernel.equations import compiled_equations
from dopt.kernel.evaluation import BLOCK
from dopt.kernel.linear_algebra import initial_covariance
from dopt.kernel.structs import Members, Network
from dopt.learning import GaussNewton, JointKalman, Learner
from dopt.limits import Limits
from dopt.models import MLP, MODELS, RFF, AffineMLP, GaussianProcess, GreyBox, Linear, LinearState
from dopt.models.base import Model
from dopt.models.linear import linear_terms
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
from dopt.randomness import Draws
from dopt.spec.compatibility import is_fresh
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox, delay, differentiated
from dopt.types import Array, Integers, Matrix, Stack, Vector

KINDS: dict[type[Model], ModelKind] = {
    MLP: ModelKind.MLP,
    Linear: ModelKind.LINEAR,
    RFF: ModelKind.RANDOM_FEATURES,
    GaussianProcess: ModelKind.GAUSSIAN_PROCESS,
    LinearState: ModelKind.LINEAR_STATE,
    GreyBox: ModelKind.GREY_BOX,
}
"""Models that the kernel evaluates, and classes derived from them."""

FEATURE_KINDS = {"identity": FeatureKind.IDENTITY, "cos": FeatureKind.COS, "sin": FeatureKind.SIN}


def network_of(system: System, model: Model) -> args.Network:
    """Return the architecture of a model on a system."""
    kinds = [kind for one, kind in KINDS.items() if isinstance(model, one)]
    if not kinds:
        raise SpecificationError(
            f"model '{model.name}' says that it is compiled, but the kernel knows "
            f"{', '.join(name for name, one in MODELS.items() if one.compiled)} alone: set "
            f"compiled = False in its class."
        )
    features = model.features(system)
    sizes: tuple[int, ...] = (len(features), 1, system.n_learned)
    inputs = sizes[:-1]
    if isinstance(model, MLP):
        sizes, inputs = model.layer_sizes(system), model.layer_inputs(system)
    lengths = [(n_in + 1) * n_out for n_in, n_out in zip(inputs, sizes[1:], strict=True)]
    n_read = model.n_inputs_read(system)
    unknown = model.names(system) if isinstance(model, GreyBox) else ()
    return args.Network(
        int(kinds[0]),
        np.array(sizes),
        np.array(inputs),
        np.cumsum([0, *lengths[:-1]]),
        n_read,
        n_read if isinstance(model, AffineMLP) else 0,
        np.array([system.physical.index(name) for name in unknown], dtype=np.int64),
        np.array([FEATURE_KINDS[feature.kind] for feature in features]),
        np.array([feature.index for feature in features]),
        np.array(model.feature_scales(system)),
        args.Waves(np.zeros((0, 0)), np.zeros(0), 1.0),
        _process(system, model),
    )


def _process(system: System, model: Model) -> args.Process:
    room, shared = 0, np.zeros((0, 0))
    if isinstance(model, GaussianProcess):
        room = model.room(system)
        if not model.is_tuned:
            shared = model.fixed_numbers(system)[None]
    selects_from = room if room == system.horizon else room // 2
    return args.Process(shared, room, selects_from, np.zeros(1, dtype=np.int64))


def network_of_trial(spec: TrialSpec, network: args.Network, weights: Vector) -> args.Network:
    """Return the architecture with what belongs to one trial.

    These are the random features that it has drawn in its weights, and the count of its samples.
    """
    if isinstance(spec.model, GaussianProcess):
        return network._replace(process=_process(spec.system, spec.model))
    if not isinstance(spec.model, RFF):
        return network
    D, p = spec.model.n_features, len(spec.system.features)
    frequencies, phases = weights[-D * (p + 1) : -D].reshape(D, p), weights[-D:]
    waves = args.Waves(frequencies.copy(), phases.copy(), spec.model.scale)
    return network._replace(waves=waves)


def members_of(model: Model, weights: Vector) -> Members:
    """Return the networks of an ensemble with the parameters that a trial has drawn for them."""
    count = model.n_members if model.n_members > 1 else 0
    drawn = weights.reshape(count, -1) if count else np.zeros((0, 0))
    return Members(drawn.copy(), drawn.copy())


def initial_state(spec: TrialSpec, weights: Vector, record: args.Record) -> args.State:
    """Return the state of a trial before its first step.

    ``weights`` are all initial parameters of the model; the state holds those that are learned.
    """
    system, q = spec.system, n_learned_parameters(spec.config)
    window = spec.learner.samples_kept(system.horizon)
    covariance, factor, dual, sketch = _information(spec, q)
    return args.State(
        theta=weights[:q].copy(),
        prior=weights[:q].copy(),
        members=members_of(spec.model, weights),
        moment_1=np.zeros(q),
        moment_2=np.zeros(q),
        covariance=covariance,
        factor=factor,
        dual=dual,
        sketch=sketch,
        visited=_visited(spec),
        posterior=_posterior(spec),
        prediction=_prediction_error(spec),
        estimate=_estimate(spec, q, record.inputs),
        window_features=np.zeros((len(spec.model.features(system)), window)),
        window_targets=np.zeros((system.n_learned, window)),
        policy_memory=np.zeros(spec.policy.memory_size(system, q)),
        learner_memory=np.zeros(spec.learner.memory_size(system, q)),
    )


def _information(spec: TrialSpec, q: int) -> tuple[args.Covariance, Matrix, args.Dual, args.Sketch]:
    """Return the initial information in the chosen form; the other forms are empty."""
    policy = spec.policy
    form = form_of(spec.config)
    size, rows, projection = 0, _empty_dual(spec, 0), count_sketch(0, 1)
    factored = q if isinstance(policy, ICEM) and _is_fitted(spec.learner) else 0
    if form == Form.PRIMAL and _needs_inverse(spec.config):
        size = q
    elif form == Form.DUAL:
        rows = _empty_dual(spec, spec.system.horizon)
    elif form == Form.SKETCH and isinstance(policy, DOptimal):
        size = policy.sketch_size
        projection = count_sketch(q, size)
    covariance = initial_covariance(
        size, regularization_of(spec.config), spec.system.n_learned, 1 + spec.system.n_inputs
    )
    factor = np.eye(factored) * regularization_of(spec.config) ** 0.5
    return covariance, factor, rows, args.Sketch(*projection, size)


def _needs_inverse(config: TrialConfig) -> bool:
    """Return True if the policy or the learner reads M⁻¹; a learner that refits M may not."""
    policy = config.policy
    reads = isinstance(policy, InformationPolicy) and not isinstance(policy, ICEM)
    return config.information is not None and (reads or not _is_fitted(config.learner))


def _is_fitted(learner: Learner) -> bool:
    """Return True if a learner refits M at each step."""
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
        regularization_of(spec.config),
    )


def _prediction_error(spec: TrialSpec) -> args.PredictionError:
    r, m = spec.system.n_learned, spec.system.n_inputs
    if spec.config.limits is None or not spec.config.limits.enforced:
        r = m = 0
    return args.PredictionError(np.zeros(r), np.zeros((2, r)), np.zeros(m))


def _estimate(spec: TrialSpec, q: int, applied: Matrix) -> args.Estimate:
    """Return what is remembered to estimate states, without room where they are known."""
    system, estimates = spec.system, spec.learner.estimates_states
    steps = system.horizon if system.n_measured else 0
    d = system.n_states if system.n_measured and estimates else 0
    noise = spec.learner.noise_variance if isinstance(spec.learner, JointKalman) else np.nan
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
        np.array([noise]),
    )


def _posterior(spec: TrialSpec) -> args.Posterior:
    """Return the room for the samples of Gaussian processes, none in other models."""
    room, kernels, r = 0, 0, spec.system.n_learned
    if isinstance(spec.model, GaussianProcess):
        room, kernels = spec.model.room(spec.system), r if spec.model.is_tuned else 1
    return args.Posterior(
        np.zeros((2 * kernels, room, room)),  # what nothing is written to takes no memory
        np.zeros((r, room)),
        np.zeros((r, room)),
        np.zeros(room),
        np.zeros(1, dtype=np.int64),
        np.zeros(spec.system.n_states),
        np.zeros(r),
    )


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
        regularization_of(spec.config),
    )


def empty_scratch(spec: TrialSpec, network: Network) -> args.Scratch:
    """Return the memory that a learning step overwrites, for the largest batch of the learner."""
    room = int(max(network.sizes[1], spec.system.n_learned)) * spec.learner.largest_batch()
    depth, q = len(network.offsets) - 1, n_learned_parameters(spec.config)
    return args.Scratch(np.empty((depth, room)), np.empty((3, room)), np.empty(q))


def empty_record(system: System) -> args.Record:
    """Return the record of a trial before its first step."""
    steps = system.horizon
    states = np.full((steps + 1, system.n_states), np.nan)
    if not isinstance(system, BlackBox):  # which starts where it is measured
        states[0] = system.initial_state
    true_states = states.copy() if system.n_measured else states
    rows = (np.full(steps, np.nan) for _ in range(5))
    return args.Record(states, true_states, np.zeros((steps, system.n_inputs)), *rows)


def n_learned_parameters(config: TrialConfig) -> int:
    """Return the number of parameters that are learned, the first ones."""
    model, system = config.model, config.system
    return model.n_member_parameters(system) - model.n_fixed_parameters(system)


def regularization_of(config: TrialConfig) -> float:
    """Return λ of M₀ = λI, 1 where there is no M."""
    return config.information.regularization if config.information else 1.0


def form_of(config: TrialConfig) -> int:
    """Return the form of the information matrix, PRIMAL where no M is held."""
    held = config.information
    return int(Form[held.form.upper()] if held else Form.PRIMAL)


FORMS = {
    Form.PRIMAL: information.PRIMAL,
    Form.DUAL: information.DUAL,
    Form.SKETCH: information.SKETCH,
}


@functools.lru_cache(maxsize=64)
def constants(config: TrialConfig) -> tuple[args.Plant, args.Network, args.Algorithm]:
    """Return what the trials of a configuration share, without their evaluation points."""
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
        plant=plant,
        network=network,
        algorithm=algorithm,
        information=information_of(spec.config),
        limits=limits_of(spec.config),
        sensors=sensors_of(spec.config),
        randomness=randomness_of(spec, draws),
        state=initial_state(spec, draws.weights, record),
        scratch=empty_scratch(spec, network),
        record=record,
    )


def plant_of(system: System) -> args.Plant:
    """Return the constants of a system."""
    equations = compiled_equations(system)
    return args.Plant(
        known=equations.known,
        accelerations=equations.accelerations,
        complex_accelerations=equations.complex_accelerations,
        parameters=np.array(system.parameters),
        history=np.array(system.history),  # a copy: what came through Ray's memory is read-only
        linear_form=np.array(system.linear_form),
        learned_rows=np.array(system.learned_rows),
        n_inputs=system.n_inputs,
        n_inputs_read=system.n_inputs if system.reads_inputs else 0,
        dt=system.dt,
        gamma=system.gamma,
        state_limit=system.state_limit,
        integrator=int(Integrator[system.integrator.upper()]),
        n_carried=system.n_carried,
        lead=system.lead_steps,
        cut_at=system.cut_at,
    )


def algorithm_of(config: TrialConfig) -> args.Algorithm:
    """Return the settings of the policy and the learner of a configuration."""
    q, policy, learner = n_learned_parameters(config), config.policy, config.learner
    regularization = regularization_of(config)
    return args.Algorithm(
        np.array(policy.kernel_numbers(q, regularization)),
        np.array(learner.kernel_numbers(q, regularization)),
        _search(config),
    )


def information_of(config: TrialConfig) -> args.Information:
    """Return the functions for the form that holds M, which are compiled when a trial runs."""
    if not isinstance(config.policy, InformationPolicy) or config.information is None:
        return information.ABSENT
    form = FORMS[Form(form_of(config))]
    if is_fresh(config.policy):
        form = information.FRESH  # which goes with the primal form
    searches = isinstance(config.policy, (Search, ICEM))
    return args.Information(
        (information.ABSENT if config.learner.updates_information else form).add_rows,
        (information.ABSENT if searches else form).planning_forms,
    )


def _search(config: TrialConfig) -> args.Search:
    """Return the plans of a policy that searches."""
    policy, system, q = config.policy, config.system, n_learned_parameters(config)
    found = args.Search(
        np.zeros((0, system.n_inputs)),
        np.zeros((0, system.n_states)),
        np.zeros((2, 0)),
        np.zeros((0, q)),
        config.information.noise_variance**-0.5 if config.information else 1.0,
    )
    if isinstance(policy, (Search, HeldCandidates)):
        steps = policy.steps(system)
        candidates = policy.compared_inputs(system)
        found = found._replace(candidates=candidates, steps=steps, switch=steps // 2)
    if isinstance(policy, Search):
        found = found._replace(score=int(policy.score), budget_us=policy.budget_us)
    if isinstance(policy, Lookahead):
        found = found._replace(stride=policy.stride_of(system))
    if isinstance(policy, TaskOptimal):
        found = found._replace(task_states=task_states(system, policy))
    if isinstance(policy, EOptimal):
        starts = policy.starts(q, system.n_learned)
        found = found._replace(starts=starts, subspace=policy.subspace)
    if isinstance(policy, ICEM):
        names = ("stride", "hold", "plans", "iterations", "elites", "task_count")
        found = found._replace(
            task_states=box_states(system) if policy.task_count else found.task_states,
            domain=domain_box(system, policy.domain),
            score=int(policy.score),
            steps=policy.lookahead,
            replan_every=getattr(policy, "replan_every", 1),
            **{name: getattr(policy, name) for name in names},
        )
    return found


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


def sensors_of(config: TrialConfig) -> args.Sensors:
    """Return what is measured of the states of a configuration; nothing where all are known."""
    system, estimates = config.system, config.learner.estimates_states
    positions, factors = differentiated(system) if system.measured_states else ([], [])
    return args.Sensors(
        system.output_rows,
        np.array(system.measured_states, dtype=np.int64),
        np.array(system.measurement_noise, dtype=float) ** 2,
        np.array(system.output_quanta, dtype=float),
        np.array(positions, dtype=np.int64),
        np.array(factors, dtype=float),
        0.0 if estimates else system.velocity_cutoff,
        delay(system) if system.n_measured and not estimates else 0.0,
        np.zeros(system.n_states),  # the initial state of a simulation is known
    )


def randomness_of(spec: TrialSpec, draws: Draws) -> args.Randomness:
    """Return the numbers that a trial has drawn; draws of parameters are of the learned ones."""
    drawn = args.Randomness(*(getattr(draws, name) for name in args.Randomness._fields))
    return drawn._replace(parameters=drawn.parameters[: n_learned_parameters(spec.config)])


def evaluation_points(system: System, model: Model, network: args.Network) -> args.Evaluation:
    """Return the points of a system in the form that its model takes."""
    points, none = evaluation_set(system), np.zeros((0, 0, 0))
    at, n_grid = system.points(points.states, points.inputs), points.n_grid
    found = args.Evaluation(
        single=none.astype(np.float32),
        features=none,
        basis=none,
        n_basis=np.zeros(1, dtype=np.int64),
        block_targets=none,
        block_sizes=np.zeros(0, dtype=np.int64),
        regressors=none,
        targets=np.zeros((0, 0)),
        states=at if len(system.history) > 1 else at[:0],
        bounds=np.array([0, n_grid, len(at)]),
        target_size=_size(system, points),
    )
    if network.kind == ModelKind.LINEAR:
        offset, regressors = linear_terms(system, at)
        targets = np.ascontiguousarray(points.accelerations - offset)
        return found._replace(regressors=np.ascontiguousarray(regressors), targets=targets)
    features = model.featurize(system, model.points(system, points.states, points.inputs)).T
    truth, parts = points.accelerations.T, (slice(0, n_grid), slice(n_grid, None))
    cut = (_blocks(features[:, part], truth[:, part]) for part in parts)
    blocks, block_targets, sizes = zip(*cut, strict=True)
    return found._replace(
        single=np.concatenate(blocks).astype(np.float32),
        features=np.concatenate(blocks),
        block_targets=np.concatenate(block_targets),
        block_sizes=np.concatenate(sizes),
        bounds=np.cumsum([0, *map(len, sizes)], dtype=np.int64),
    )


def points_of_trial(points: args.Evaluation, network: args.Network) -> args.Evaluation:
    """Return points with what a trial has for itself.

    These are its random features at the points, or room for the kernel between the points and its
    samples, and targets to write into if the truth changes with time.
    """
    if len(points.states):
        own = (points.block_targets.copy(), points.targets.copy())
        points = points._replace(block_targets=own[0], targets=own[1])
    if network.kind == ModelKind.RANDOM_FEATURES:
        values = network.waves.frequencies @ points.features
        values += network.waves.phases[:, None]
        np.cos(values, out=values)
        values *= network.waves.scale
        points = points._replace(basis=values, n_basis=np.array([values.shape[1]]))
    elif network.kind == ModelKind.LINEAR_STATE:
        points = points._replace(basis=points.features)
    elif network.kind == ModelKind.GAUSSIAN_PROCESS:
        kernels = network.sizes[2] if len(network.process.shared) == 0 else 1
        room = np.zeros((kernels * points.bounds[2], network.process.room, BLOCK))
        points = points._replace(basis=room, n_basis=np.zeros(1, dtype=np.int64))
    return points


def _blocks(features: Array, targets: Array) -> tuple[Stack, Stack, Integers]:
    """Cut columns of points, (·, N), into padded blocks, (blocks, ·, BLOCK), and their sizes."""
    n = features.shape[1]
    starts = range(0, n, BLOCK)
    sizes = np.array([min(BLOCK, n - start) for start in starts], dtype=np.int64)

    def cut(columns: Array) -> Array:
        padded = np.zeros((len(columns), BLOCK * len(starts)))
        padded[:, :n] = columns
        return np.ascontiguousarray(padded.reshape(len(columns), -1, BLOCK).swapaxes(0, 1))

    return cut(features), cut(targets), sizes


def _size(system: System, points: EvaluationSet) -> float:
    """Return the root mean square norm of the targets, at the first or the last step."""
    ends = [points.accelerations]
    if len(system.history) > 1:
        ends.append(system.learned(points.states, system.horizon - 1, points.inputs))
    return max(float(np.sqrt(np.mean(np.sum(targets**2, axis=1)))) for targets in ends)
