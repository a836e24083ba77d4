"""Check that policy, model, learner and system can be combined."""

from __future__ import annotations

import functools

from dopt.errors import IncompatibleError
from dopt.learning import (
    LEARNERS,
    Adam,
    ExtendedKalman,
    GaussNewton,
    InformationLearner,
    JointKalman,
    Learner,
)
from dopt.models import (
    MODELS,
    AffineMLP,
    BlackBoxMLP,
    Ensemble,
    GaussianProcess,
    GreyBox,
    Linear,
    LinearState,
    Model,
)
from dopt.policies import InformationPolicy, Oracle, Policy
from dopt.policies.disagreement import Disagreement
from dopt.policies.gaussian_process import GaussianProcessEntropy
from dopt.policies.greedy_linear import GreedyLinear
from dopt.spec.information_form import held_information, is_fresh
from dopt.systems import System
from dopt.systems.black_box import BlackBox
from dopt.systems.input_effect import input_effect
from dopt.systems.plant import ExploredPlant
from dopt.systems.sensors import differentiated


def check_together(system: System, policy: Policy, model: Model, learner: Learner) -> None:
    """Raise IncompatibleError if choices that are valid one by one make no sense together."""
    given = f"model '{model.name}'"
    for kind, fitting in _MODELS_OF.items():
        if isinstance(policy, kind) and not isinstance(model, fitting):
            raise mismatch(f"policy '{policy.name}'", f"model '{fitting.name}'", given)
    if isinstance(policy, Disagreement) and model.structure != "gradient":
        raise mismatch(f"policy '{policy.name}'", _models("gradient"), given)
    if isinstance(policy, Disagreement) and not isinstance(learner, Adam):
        expected = "learner 'adam' or 'adam_window', which can learn for many networks"
        raise mismatch(f"policy '{policy.name}'", expected, f"learner '{learner.name}'")
    _check_sensors(system, learner)
    _check_model(system, policy, model, learner)
    _check_inputs(system, policy, model, learner)
    if not _teaches(type(learner), type(model)):
        raise mismatch(
            f"learner '{learner.name}'",
            f"{_taught(learner)} and {given} with {_teachers(model)}",
            "the two together",
            "were",
        )
    if isinstance(model, Ensemble) and isinstance(learner, GaussNewton) and learner.refit_every > 1:
        # a filter between two fits would keep the M of one network
        every = f"learner.refit_every {learner.refit_every}"
        raise mismatch(f"model '{model.name}'", "learner.refit_every 1", every)


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
    unknown = [i for i, position in enumerate(differentiated(system)) if position < 0]
    if unknown and not learner.estimates_states:
        names = ", ".join(system.state_labels[i] for i in unknown)
        expected = (
            f"learner 'joint_ekf' where the known part does not say that a state is the rate of a "
            f"measured one ({names})"
        )
        raise mismatch("a choice of measured states", expected, f"learner '{learner.name}'")


def _teaches(learner: type[Learner], model: type[Model]) -> bool:
    """Tell whether a learner can learn a model's parameters.

    A filter also learns those of physics, and a learner that fits anew the networks of an ensemble.
    """
    filtered = issubclass(learner, ExtendedKalman | JointKalman) and issubclass(model, Linear)
    fitted = issubclass(learner, GaussNewton) and issubclass(model, Ensemble)
    return filtered or fitted or learner.structure == model.structure


def _taught(learner: Learner) -> str:
    return _choice("model", [name for name, one in MODELS.items() if _teaches(type(learner), one)])


def _teachers(model: Model) -> str:
    return _choice(
        "learner", [name for name, one in LEARNERS.items() if _teaches(one, type(model))]
    )


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
    if (sharing or model.structure == "least_squares") and form not in ("auto", "primal"):
        what = f"learner '{learner.name}'" if sharing else f"model '{model.name}'"
        raise mismatch(what, "policy.form 'primal' or 'auto'", f"policy.form '{form}'")
    if isinstance(policy, InformationPolicy):
        _check_information(system, policy, model, learner)
    if model.structure == "conditioning" and hasattr(policy, "regularization"):
        expected = "a policy that needs no information matrix of parameters"
        raise mismatch(f"model '{model.name}'", expected, given)


def _check_unknown(system: System, model: GreyBox) -> None:
    """Check that a grey box has unknown parameters, each of the system's and with one guess."""
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
    for part in (policy, learner):
        if not part.reads_inputs:
            expected = "a model of the state alone, such as 'mlp'"
            raise mismatch(f"{part.section} '{part.name}'", expected, f"model '{model.name}'")
    form = getattr(policy, "form", "auto")
    q, n_rows = model.n_member_parameters(system), system.n_learned * system.horizon
    if isinstance(model, AffineMLP) and isinstance(policy, InformationPolicy):
        held = held_information(policy, learner, q, n_rows)
        if held and held.form == "dual":
            expected = "policy.form 'primal' or 'sketch'"
            chosen = "policy.form 'auto', which takes 'dual' here," if form == "auto" else None
            raise mismatch("model 'affine'", expected, chosen or f"policy.form '{form}'")


@functools.lru_cache(maxsize=64)
def without_known_effect(system: System) -> bool:
    """Tell whether the known part of a measured plant leaves out an input."""
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
        raise mismatch(what, _models("gradient"), f"model '{model.name}'")
    if learner.updates_information:
        raise mismatch(what, "a learner that leaves M to the policy", f"learner '{learner.name}'")
    q, n_rows = model.n_member_parameters(system), system.n_learned * system.horizon
    form = policy.chosen_form(q, n_rows)
    if form != "primal":
        expected = "policy.form 'primal' or 'auto'" if hasattr(policy, "form") else "form 'primal'"
        found = f"policy.form '{form}'" if hasattr(policy, "form") else f"form '{form}'"
        raise mismatch(what, expected, found)


def _models(structure: str) -> str:
    return _choice("model", [name for name, one in MODELS.items() if one.structure == structure])


def mismatch(what: str, expected: str, given: str, verb: str = "was") -> IncompatibleError:
    """Return the error for two choices that do not go together."""
    return IncompatibleError(
        f"{what} goes with {expected}, but {given} {verb} given: change one of them."
    )
