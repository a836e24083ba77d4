"""Translation of a trial's specification to the structures of the trial."""

from __future__ import annotations

import functools

import numpy as np

from dopt.algorithm import Form, Integrator, ModelKind, Score, switch_step
from dopt.evaluation import EvaluationSet, evaluation_set
from dopt.kernel import information
from dopt.kernel import structs as args
from dopt.kernel.equations import compiled_equations
from dopt.kernel.evaluation import BLOCK
from dopt.kernel.evidence import Evidence, is_tuned
from dopt.kernel.state_from_spec import (
    empty_record,
    empty_scratch,
    form_of,
    held_form,
    initial_state,
    n_learned_parameters,
    network_of,
    network_of_trial,
    regularization_of,
)
from dopt.limits import Limits
from dopt.models import MLP
from dopt.models.base import Model
from dopt.policies import (
    ICEM,
    EOptimal,
    InformationPolicy,
    Lookahead,
    Search,
    TaskOptimal,
)
from dopt.policies.held_candidates import HeldCandidates
from dopt.policies.search import score_code
from dopt.policies.task_states import box_states, domain_box, task_states
from dopt.randomness import Draws, draw
from dopt.spec.compatibility import is_fresh
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import delay, differentiated, rate_factors
from dopt.types import Array, Integers, Stack

FORMS_OF_NETWORKS = {
    Form.PRIMAL: information.NETWORK,
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
    if not isinstance(config.policy, InformationPolicy) or held_form(config) is None:
        return information.ABSENT
    network = isinstance(config.model, MLP)
    form = FORMS_OF_NETWORKS[Form(form_of(config))] if network else information.OF_OTHER_MODELS
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
    steps, score, held = 0, Score.JOINT, held_form(config)
    candidates = np.zeros((0, system.n_inputs))
    if isinstance(policy, Search):
        steps, score = policy.steps(system), score_code(policy)
        candidates = policy.compared_inputs(system)
    elif isinstance(policy, HeldCandidates):
        steps = policy.lookahead + system.lead_steps
        candidates = policy.compared_inputs(system)
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
    return args.Sensors(
        system.output_rows,
        np.array(system.measured_states, dtype=np.int64),
        np.array(system.measurement_noise, dtype=float) ** 2,
        np.array(system.output_quanta, dtype=float),
        np.array(differentiated(system) if system.measured_states else [], dtype=np.int64),
        np.array(rate_factors(system) if system.measured_states else []),
        0.0 if estimates else system.velocity_cutoff,
        delay(system) if system.n_measured and not estimates else 0.0,
        np.zeros(system.n_states),  # the initial state of a simulation is known
    )


def randomness_of(spec: TrialSpec, draws: Draws) -> args.Randomness:
    """Return the numbers that a trial has drawn; draws of parameters are of the learned ones."""
    drawn = args.Randomness(*(getattr(draws, name) for name in args.Randomness._fields))
    return drawn._replace(parameters=drawn.parameters[: n_learned_parameters(spec.config)])


class KernelState:
    """Observations and learned parameters of a trial in the compiled kernel.

    Attributes
    ----------
    trial : Trial
        Arguments of the compiled functions.
    state, record : State, Record
        Its arrays that they write in place.
    """

    def __init__(self, spec: TrialSpec) -> None:
        draws = draw(spec)
        self.spec, self.trial = spec, trial_of(spec, draws)
        self.state, self.record = self.trial.state, self.trial.record
        self.evidence = Evidence(spec, self.trial) if is_tuned(spec.model) else None
        n_fixed = spec.model.n_fixed_parameters(spec.system)
        self._fixed = draws.weights[len(draws.weights) - n_fixed :]

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,), of all members, and those that stay as they were drawn."""
        if self.state.members.parameters.shape[0] > 0:
            return self.state.members.parameters.flatten()
        return np.concatenate([self.state.theta, self._fixed])

    @property
    def states(self) -> Array:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet.

        Of a simulation they are the true ones.
        """
        return self.record.true_states


def evaluation_points(system: System, model: Model, network: args.Network) -> args.Evaluation:
    """Return the points of a system in the form that its model takes."""
    points = evaluation_set(system)
    if network.kind == ModelKind.LINEAR:
        return _linear_evaluation(system, points)
    features = model.featurize(system, model.points(system, points.states, points.inputs))
    columns = [features.T, points.accelerations.T]
    parts = [slice(0, points.n_grid), slice(points.n_grid, None)]
    blocks_of_features, targets, sizes = zip(
        *(_blocks(columns[0][:, part], columns[1][:, part]) for part in parts), strict=True
    )
    blocks = np.concatenate(blocks_of_features)
    return args.Evaluation(
        blocks.astype(np.float32),
        blocks,
        np.zeros((0, 0, 0)),
        np.zeros(1, dtype=np.int64),
        np.concatenate(targets),
        np.concatenate(sizes),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0)),
        _followed(system, points),
        _bounds(*map(len, sizes)),
        _size(system, points),
    )


def _bounds(n_grid: int, n_reachable: int) -> Integers:
    """Return where the grid begins and ends, and where the reachable set ends."""
    return np.cumsum([0, n_grid, n_reachable], dtype=np.int64)


def _followed(system: System, points: EvaluationSet) -> Array:
    """Return the states at which the truth is evaluated again at each step."""
    followed = system.points(points.states, points.inputs)
    return followed if len(system.history) > 1 else followed[:0]


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


def _linear_evaluation(system: System, points: EvaluationSet) -> args.Evaluation:
    at = system.points(points.states, points.inputs)
    offset, *units = (
        np.stack(np.broadcast_arrays(*system.accelerations(tuple(at.T), form)), axis=-1)
        for form in system.linear_form
    )
    regressors = np.stack([unit - offset for unit in units], axis=-1)
    return args.Evaluation(
        np.zeros((0, 0, 0), dtype=np.float32),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0, 0)),
        np.zeros(1, dtype=np.int64),
        np.zeros((0, 0, 0)),
        np.zeros(0, dtype=np.int64),
        np.ascontiguousarray(regressors),
        np.ascontiguousarray(points.accelerations - offset),
        _followed(system, points),
        _bounds(points.n_grid, len(points.states) - points.n_grid),
        _size(system, points),
    )


def _size(system: System, points: EvaluationSet) -> float:
    """Return the root mean square norm of the targets, at the first or the last step."""
    ends = [points.accelerations]
    if len(system.history) > 1:
        ends.append(system.learned(points.states, system.horizon - 1, points.inputs))
    return max(float(np.sqrt(np.mean(np.sum(targets**2, axis=1)))) for targets in ends)
