"""Checks of a trial: parts that can be combined, its information matrix, and its memory.

The estimate of memory counts matrices, and arrays over steps and points. What else a trial holds is
small beside these, or is stopped by the limit of its process (``launch.memory_gib``). The
interpreter and its libraries, some 0.2 GiB, come on top.

Legend of sizes: T steps, d states, m inputs, r learned accelerations, p features, q parameters,
w units in each hidden layer, N points of the evaluation grid.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple, TypeGuard

from dopt.algorithm import Score
from dopt.errors import IncompatibleError
from dopt.learning import (
    LEARNERS,
    Adam,
    ExtendedKalman,
    GaussNewton,
    InformationLearner,
    JointKalman,
    Learner,
    RecursiveLeastSquares,
    SimulationError,
)
from dopt.learning.base import CustomLearner
from dopt.models import (
    MLP,
    MODELS,
    RFF,
    AffineMLP,
    BlackBoxMLP,
    Ensemble,
    GaussianProcess,
    GreyBox,
    Linear,
    LinearState,
    Model,
)
from dopt.policies import ICEM, DOptimal, InformationPolicy, Oracle, Policy, Search, Uniform
from dopt.policies.base import CustomPolicy, OpenLoop
from dopt.policies.d_optimal import GreedyLinear
from dopt.policies.held_candidates import Disagreement, GaussianProcessEntropy
from dopt.systems import System
from dopt.systems.black_box import BlackBox, differentiated
from dopt.systems.plant import ExploredPlant
from dopt.systems.properties import input_effect


class Information(NamedTuple):
    """The one information matrix M of a trial.

    Attributes
    ----------
    form : {"primal", "dual", "sketch"}
        Its representation (:class:`dopt.policies.DOptimal`).
    regularization : float
        λ of M₀ = λI.
    noise_variance : float
        ρ: a sample adds JᵀJ/ρ to M.
    """

    form: str
    regularization: float
    noise_variance: float = 1.0


def held_information(
    system: System, policy: Policy, model: Model, learner: Learner
) -> Information | None:
    """Return what M a trial holds; None where nothing needs one.

    A policy that plans by M shares it with a learner that updates it, which needs the gain in the
    space of the parameters and hence the primal form.
    """
    if learner.structure == "conditioning":
        return None
    sharing = learner if isinstance(learner, (InformationLearner, RecursiveLeastSquares)) else None
    noise_variance = sharing.noise_variance if isinstance(sharing, InformationLearner) else 1.0
    if isinstance(policy, InformationPolicy):
        sizes = model.n_member_parameters(system), system.n_learned * system.horizon
        form = "primal" if sharing else policy.chosen_form(*sizes)
        return Information(form, policy.regularization, noise_variance)
    if sharing is None:
        return None
    ridge = float(getattr(policy, "regularization", sharing.regularization))
    return Information("primal", ridge, noise_variance)


def is_fresh(policy: Policy) -> TypeGuard[InformationPolicy]:
    """Return True if M is summed from the rows of all states at the present parameters."""
    return isinstance(policy, InformationPolicy) and policy.information == "fresh"


def check_together(system: System, policy: Policy, model: Model, learner: Learner) -> None:
    """Raise IncompatibleError if choices that are valid one by one make no sense together."""
    given = f"model '{model.name}'"
    for kind, fitting in _MODELS_OF.items():
        if isinstance(policy, kind) and not isinstance(model, fitting):
            raise mismatch(f"policy '{policy.name}'", f"model '{fitting.name}'", given)
    if isinstance(policy, Disagreement) and not (isinstance(model, MLP) and model.n_members == 1):
        raise mismatch(f"policy '{policy.name}'", "model 'mlp'", given)
    if isinstance(policy, Disagreement) and not isinstance(learner, Adam):
        expected = "learner 'adam' or 'adam_window', which can learn for many networks"
        raise mismatch(f"policy '{policy.name}'", expected, f"learner '{learner.name}'")
    if isinstance(learner, SimulationError):
        if not isinstance(system, ExploredPlant):
            expected = "a dopt.Plant that a dopt.Explorer explores"
            raise mismatch(f"learner '{learner.name}'", expected, f"env '{system.name}'")
        if isinstance(model, MLP) and model.depth != 1:
            shown = f"model.depth {model.depth}"
            raise mismatch(f"learner '{learner.name}'", "model.depth 1", shown)
    _check_sensors(system, learner)
    _check_model(system, policy, model, learner)
    _check_inputs(system, policy, model, learner)
    if not _teaches(type(learner), type(model)):
        taught = [name for name, one in MODELS.items() if _teaches(type(learner), one)]
        offered = [name for name, one in LEARNERS.items() if _teaches(one, type(model))]
        teachers = [name for name in offered if _learns_in(LEARNERS[name], system)]
        expected = f"{_choice('model', taught)} and {given} with {_choice('learner', teachers)}"
        raise mismatch(f"learner '{learner.name}'", expected, "the two together", "were")
    fits = not isinstance(learner, GaussNewton) or learner.refit_every == 1
    if isinstance(model, Ensemble) and not fits:
        # a filter between two fits would keep the M of one network
        every = f"learner.refit_every {getattr(learner, 'refit_every', 1)}"
        raise mismatch(f"model '{model.name}'", "learner.refit_every 1", every)


def check_reference(
    parts: tuple[System, Policy, Model, Learner], *, enforced: bool = False
) -> None:
    """Raise IncompatibleError if the torch path does not run a trial with these parts.

    ``enforced`` says whether limits replace inputs.
    """
    system, policy, model, learner = parts
    least_squares = isinstance(learner, RecursiveLeastSquares) and isinstance(model, Linear)
    network = (isinstance(model, MLP) and model.n_members == 1) or not model.compiled
    plans = isinstance(policy, OpenLoop | CustomPolicy) or type(policy) in REFERENCE_POLICIES
    for what, runs in (
        (f"policy '{policy.name}'", plans),
        (f"model '{model.name}'", network or isinstance(model, Linear)),
        (f"model '{model.name}' with the inputs that it reads", not model.n_inputs_read(system)),
        (
            f"learner '{learner.name}'",
            (isinstance(learner, Adam | CustomLearner) and not isinstance(learner, SimulationError))
            or least_squares,
        ),
        ("policy.information 'fresh'", not is_fresh(policy)),
        ("states that are measured with noise", not system.n_measured),
        ("limits", not enforced),
        ("plant 'real'", system.wrapped is None),
        ("env.restarts", not getattr(system, "restarts", False)),
    ):
        if not runs:
            raise IncompatibleError(_kernel_alone(what, parts))


REFERENCE_POLICIES = (DOptimal, Oracle, Uniform)
"""Closed-loop policies that the torch path plans by; open-loop and numpy ones run there as well."""


def _kernel_alone(what: str, parts: tuple[System, Policy, Model, Learner]) -> str:
    """Return the sentence for what runs in the compiled kernel alone."""
    in_torch = [f"{one.section} '{one.name}' runs in torch" for one in parts if not one.compiled]
    why = in_torch[0] if in_torch else "path is 'reference', as with executor=lockstep"
    return (
        f"{what} runs in the compiled kernel alone, but {why}: choose compiled parts alone and "
        f"leave path out, with executor=local, or what runs in torch: the policies "
        f"{', '.join(one.name for one in REFERENCE_POLICIES)}, open-loop ones and plans in numpy, "
        f"with learner 'adam' or 'adam_window'."
    )


def _check_sensors(system: System, learner: Learner) -> None:
    """Check that states which are measured with noise can be estimated, and only these are."""
    given = f"env '{system.name}' with all states known"
    if not system.n_measured:
        if learner.estimates_states:
            fields = "env.measured_states and env.measurement_noise, or Plant(measured=...)"
            expected = f"states that are measured with noise ({fields})"
            raise mismatch(f"learner '{learner.name}'", expected, given)
        return
    if isinstance(system, BlackBox) and not isinstance(system, ExploredPlant):
        field = "env.output_matrix" if system.output_matrix else "env.measured_states"
        raise mismatch(field, "a system with equations", f"env '{system.name}'")
    if system.output_matrix:
        if not learner.estimates_states:
            raise mismatch("env.output_matrix", "learner 'joint_ekf'", f"learner '{learner.name}'")
        return
    own = differentiated(system)[0][: system.n_states - system.n_carried]
    unknown = [i for i, position in enumerate(own) if position < 0]
    if unknown and not learner.estimates_states:
        names = ", ".join(system.state_labels[i] for i in unknown)
        expected = (
            f"learner 'joint_ekf' where the known part does not say that a state is the rate of a "
            f"measured one ({names})"
        )
        raise mismatch("a choice of measured states", expected, f"learner '{learner.name}'")


def _learns_in(learner: type[Learner], system: System) -> bool:
    """Return True if a learner runs on a system with what is measured there."""
    if issubclass(learner, SimulationError):
        return isinstance(system, ExploredPlant)
    return bool(system.n_measured) or not learner.estimates_states


def _teaches(learner: type[Learner], model: type[Model]) -> bool:
    """Return True if a learner can learn a model's parameters.

    A filter also learns physical parameters, and a learner that refits also fits ensembles.
    """
    if issubclass(learner, SimulationError):
        return model is MLP
    filtered = issubclass(learner, ExtendedKalman | JointKalman) and issubclass(model, Linear)
    fitted = issubclass(learner, GaussNewton) and issubclass(model, Ensemble)
    return filtered or fitted or learner.structure == model.structure


def _choice(kind: str, names: list[str]) -> str:
    *others, last = map(repr, names)
    return f"{kind} {', '.join(others)} or {last}" if others else f"{kind} {last}"


_MODELS_OF: dict[type[Policy], type[Model]] = {
    Oracle: Linear,
    GreedyLinear: LinearState,
    GaussianProcessEntropy: GaussianProcess,
}


def _check_model(system: System, policy: Policy, model: Model, learner: Learner) -> None:
    """Check a model with a policy, and a learner that updates M.

    A filter that holds M itself teaches the linear model without a policy that plans by M. It needs
    a variance of each parameter, hence M in the primal form, as least squares do.
    """
    given, sharing = f"policy '{policy.name}'", isinstance(learner, InformationLearner)
    if isinstance(model, Linear) and not (sharing or isinstance(policy, InformationPolicy)):
        raise mismatch("model 'linear'", "policy 'oracle'", given)
    if isinstance(model, Linear) and not system.linear_parameters:
        raise mismatch("model 'linear'", "linear parameters", f"env '{system.name}'")
    if isinstance(model, GreyBox):
        _check_unknown(system, model)
    form = getattr(policy, "form", "auto")
    primal = sharing or model.structure == "least_squares" or isinstance(model, GreyBox)
    if primal and form not in ("auto", "primal"):
        what = f"learner '{learner.name}'" if sharing else f"model '{model.name}'"
        raise mismatch(what, "policy.form 'primal' or 'auto'", f"policy.form '{form}'")
    if isinstance(policy, InformationPolicy):
        _check_information(system, policy, model, learner)
    if model.structure == "conditioning" and isinstance(policy, InformationPolicy):
        score: Score | None = getattr(policy, "score", None)
        if score not in (Score.JOINT, Score.SUM, Score.TRACE):
            expected = (
                "a policy without an information matrix of parameters, or one that compares "
                "plans by 'joint', 'sum' or 'variance' ('exact', 'trace', 'lookahead', 'icem', "
                "'episodic')"
            )
            if score is not None:
                given = f"{given} with the criterion '{score.name.lower()}'"
            raise mismatch(f"model '{model.name}'", expected, given)


def _check_unknown(system: System, model: GreyBox) -> None:
    """Check that a grey box has unknown parameters, each of the system's and with one guess."""
    if isinstance(system, ExploredPlant):  # whose accelerations are NaN
        expected = (
            "accelerations that are equations (of a plant, learner 'simulation_error' estimates "
            "the constants that are dopt.unknown())"
        )
        raise mismatch("model 'grey_box'", expected, f"env '{system.name}'")
    names = model.names(system)
    if not names or len(set(names)) < len(names) or not set(names) <= set(system.physical):
        expected = f"names out of {', '.join(system.physical) or 'none'}, none of them twice"
        raise mismatch("model.unknown", expected, f"{list(names)}")
    if model.initial and len(model.initial) != len(names):
        given = f"{len(model.initial)} numbers"
        raise mismatch("model.initial", f"one number for each of {', '.join(names)}", given, "were")


def _check_inputs(system: System, policy: Policy, model: Model, learner: Learner) -> None:
    """Check a model that reads the inputs, and a system of which it has to learn their effect."""
    readers = [name for name, one in MODELS.items() if issubclass(one, BlackBoxMLP)]
    if not model.n_inputs_read(system):
        if system.reads_inputs or without_known_effect(system):
            expected = f"a model that learns the effect of the inputs, {_choice('', readers)[1:]}"
            raise mismatch(f"env '{system.name}'", expected, f"model '{model.name}'")
        return
    if system.n_carried:  # the model would read the input that departs, and not what acts
        expected = "a model of the state alone, such as 'mlp'"
        raise mismatch("plant.delay or plant.lag", expected, f"model '{model.name}'")
    for part in (policy, learner):
        if not part.reads_inputs:
            expected = "a model of the state alone, such as 'mlp'"
            raise mismatch(f"{part.section} '{part.name}'", expected, f"model '{model.name}'")
    form = getattr(policy, "form", "auto")
    if isinstance(model, AffineMLP) and isinstance(policy, InformationPolicy):
        held = held_information(system, policy, model, learner)
        if held and held.form == "dual":
            expected = "policy.form 'primal' or 'sketch'"
            chosen = "policy.form 'auto', which takes 'dual' here," if form == "auto" else None
            raise mismatch("model 'affine'", expected, chosen or f"policy.form '{form}'")


@functools.lru_cache(maxsize=64)
def without_known_effect(system: System) -> bool:
    """Return True if the known part of a measured plant leaves out an input."""
    return isinstance(system, ExploredPlant) and bool(input_effect(system).without)


def _check_information(
    system: System, policy: InformationPolicy, model: Model, learner: Learner
) -> None:
    """Check fresh information with the learner, the model and the form of M.

    A learner that updates M decides about it. Where the model is linear in its parameters M is the
    same, fresh or accumulated, and would be stored as two trials.
    """
    what, given = "policy.information 'fresh'", f"policy.information '{policy.information}'"
    if not is_fresh(policy):
        if policy.refresh_every != 1:
            raise mismatch(f"policy.refresh_every {policy.refresh_every}", what, given)
        return
    if model.structure != "gradient":
        fitting = [name for name, one in MODELS.items() if one.structure == "gradient"]
        raise mismatch(what, _choice("model", fitting), f"model '{model.name}'")
    if learner.updates_information:
        raise mismatch(what, "a learner that leaves M to the policy", f"learner '{learner.name}'")
    q, n_rows = model.n_member_parameters(system), system.n_learned * system.horizon
    form = policy.chosen_form(q, n_rows)
    if form != "primal":
        whose, auto = ("policy.", " or 'auto'") if hasattr(policy, "form") else ("", "")
        raise mismatch(what, f"{whose}form 'primal'{auto}", f"{whose}form '{form}'")


def check_sampled(system: System, model: Model) -> None:
    """Raise IncompatibleError if the record of a trial gives no samples of a state model."""
    what, reading = "assess.sample_loss", f"model '{model.name}', which reads inputs,"
    if model.n_inputs_read(system) or system.reads_inputs:
        raise mismatch(what, "a model of the states alone", reading)
    if system.n_measured:
        raise mismatch(what, "states that are known", "states that are measured with noise", "were")
    if getattr(system, "restarts", False):
        raise mismatch(what, "trials in one piece", "env.restarts true")


def mismatch(what: str, expected: str, given: str, verb: str = "was") -> IncompatibleError:
    """Return the error for two choices that do not go together."""
    return IncompatibleError(
        f"{what} goes with {expected}, but {given} {verb} given: change one of them."
    )


NUMBER = 8
"""Bytes of a double."""


def memory_by_setting(
    system: System, policy: Policy, model: Model, learner: Learner, path: str = "kernel"
) -> dict[str, int]:
    """Return the bytes that a trial holds at once, by the setting that decides about them.

    ``path`` is what runs it, "kernel" or "reference".
    """
    T, d, m, r = system.horizon, system.n_states, system.n_inputs, system.n_learned
    p, q = len(model.features(system)), model.n_member_parameters(system)
    columns = model.n_features if isinstance(model, RFF) else 2 * p
    kept = policy.memory_size(system, q) + learner.memory_size(system, q)
    numbers = {
        # states, noise, inputs as drawn and applied, ties, radii, five columns, components
        "env.horizon": T * (2 * d + 3 * m + 8),
        # states and their mesh, targets, and features in both precisions
        "env.grid_points": math.prod(system.grid_points) * (2 * d + 2 * r + columns),
        # parameters, two moments, gradient, and the copies for the evaluation
        _size_of(model): (4 + 2 * model.n_members) * q + kept,
    }
    for setting, count in _matrices(system, policy, model, learner, path).items():
        numbers[setting] = numbers.get(setting, 0) + count
    return {setting: NUMBER * count for setting, count in numbers.items()}


def _matrices(
    system: System, policy: Policy, model: Model, learner: Learner, path: str
) -> dict[str, int]:
    """Return the numbers of the information matrix, of JᵀJ, and of the rows J of both."""
    T, r, q = system.horizon, system.n_learned, model.n_member_parameters(system)
    held = held_information(system, policy, model, learner)
    form = held.form if held else "none"
    if isinstance(model, GaussianProcess):
        C, G = model.room(system), r if model.is_tuned else 1
        points = 2 * G * C * math.prod(system.grid_points)
        return {"env.horizon": 2 * G * C**2, "env.grid_points": points}
    if form == "dual" and path == "kernel":
        return {"env.horizon": (r * T) ** 2}
    if form == "sketch" and isinstance(policy, DOptimal):
        rows = policy.sketch_size * (q if path == "reference" else 0)
        return {"policy.sketch_size": 3 * policy.sketch_size**2 + rows}
    rows = 2 * q**2 if form != "none" else 0
    if isinstance(policy, (Search, ICEM)):
        rows += q**2
    if isinstance(policy, Search):
        rows += 2 * policy.candidates * r * policy.steps(system) * q
    if isinstance(learner, JointKalman):
        rows += 4 * q**2 + T * system.n_measured * q
    return {_size_of(model): rows + _normal_matrix(system, policy, model, learner)}


def _normal_matrix(system: System, policy: Policy, model: Model, learner: Learner) -> int:
    """Return the numbers of JᵀJ and of the pairs of units of the samples over which it is summed.

    Both are 0 where each sample is added by itself.
    """
    T, p, q = system.horizon, len(model.features(system)), model.n_member_parameters(system)
    kept = T if is_fresh(policy) and model.structure == "gradient" else 0
    if isinstance(learner, GaussNewton):
        kept = learner.samples_kept(T)
    w = model.width if isinstance(model, MLP) else 1
    return 4 * q**2 + 2 * kept * (p + (max(w, p) + 1) ** 2) if kept else 0


def _size_of(model: Model) -> str:
    """Return the setting that decides how many parameters a model has."""
    if isinstance(model, MLP):
        return "model.width"
    return "model.n_features" if isinstance(model, RFF) else "model"
