"""Which policy, model and learner make sense together, and on which system."""

from __future__ import annotations

from dopt.errors import IncompatibleError
from dopt.learning import Adam, ExtendedKalman, Learner
from dopt.models import MODELS, GaussianProcess, Linear, LinearState, Model
from dopt.policies import Informed, Oracle, Policy
from dopt.policies.disagreement import Disagreement
from dopt.policies.gaussian_process import GaussianProcessEntropy
from dopt.policies.greedy_linear import GreedyLinear
from dopt.systems import System


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
    kalman = isinstance(learner, ExtendedKalman)
    _check_model(system, policy, model, kalman)
    if kalman and isinstance(model, Linear):
        return
    if learner.structure != model.structure:
        raise mismatch(
            f"learner '{learner.name}'",
            f"{_models(learner.structure)} and the other way round",
            f"learner '{learner.name}' with {given}",
        )


_MODELS_OF: dict[type[Policy], type[Model]] = {
    Oracle: Linear,
    GreedyLinear: LinearState,
    GaussianProcessEntropy: GaussianProcess,
}


def _check_model(system: System, policy: Policy, model: Model, kalman: bool) -> None:
    """Check a model with a policy, and whether the learner is a Kalman filter.

    A filter that holds M itself teaches the linear model without a policy that plans by M. It needs
    a variance of each parameter, hence M in the primal form, as least squares do.
    """
    given = f"policy '{policy.name}'"
    if isinstance(model, Linear) and not (kalman or isinstance(policy, Informed)):
        raise mismatch("model 'linear'", "policy 'oracle'", given)
    if isinstance(model, Linear) and not system.linear_parameters:
        raise mismatch("model 'linear'", "linear parameters", f"env '{system.name}'")
    form = getattr(policy, "form", "auto")
    if (kalman or model.structure == "least_squares") and form not in ("auto", "primal"):
        what = "learner 'ekf'" if kalman else f"model '{model.name}'"
        raise mismatch(what, "policy.form 'primal' or 'auto'", f"policy.form '{form}'")
    if model.structure == "conditioning" and hasattr(policy, "regularization"):
        expected = "a policy that needs no information matrix of parameters"
        raise mismatch(f"model '{model.name}'", expected, given)


def _models(structure: str) -> str:
    names = [name for name, model in MODELS.items() if model.structure == structure]
    return f"model {' or '.join(repr(name) for name in names)}"


def mismatch(what: str, expected: str, given: str) -> IncompatibleError:
    """Return the error for two choices that do not go together."""
    return IncompatibleError(
        f"{what} goes with {expected}, but {given} was given: change one of them."
    )
