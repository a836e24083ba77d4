"""Translation of a trial's specification to its network and what its steps write."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import FeatureKind, Form, ModelKind
from dopt.errors import SpecificationError
from dopt.kernel import structs as args
from dopt.kernel.linear_algebra import initial_covariance
from dopt.kernel.structs import Members, Network
from dopt.learning import GaussNewton, JointKalman, Learner
from dopt.models import (
    MLP,
    MODELS,
    RFF,
    AffineMLP,
    GaussianProcess,
    GreyBox,
    Linear,
    LinearState,
)
from dopt.models.base import Model
from dopt.policies import ICEM, DOptimal, InformationPolicy
from dopt.policies.d_optimal import count_sketch
from dopt.spec.compatibility import Information, held_information, is_fresh
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.types import Matrix, Vector

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
    return held_form(config) is not None and (reads or not _is_fitted(config.learner))


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
    factors = np.zeros((kernels, room, room))
    return args.Posterior(factors, np.zeros((r, room)), np.zeros((r, room)), np.zeros(room))


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
    held = held_form(config)
    return held.regularization if held else 1.0


def held_form(config: TrialConfig) -> Information | None:
    """Return the form in which M is held, None where there is no M."""
    q, n_rows = (
        config.model.n_member_parameters(config.system),
        config.system.n_learned * config.system.horizon,
    )
    return held_information(config.policy, config.learner, q, n_rows)


def form_of(config: TrialConfig) -> int:
    """Return the form of the information matrix, PRIMAL where no M is held."""
    held = held_form(config)
    return int(Form[held.form.upper()] if held else Form.PRIMAL)
