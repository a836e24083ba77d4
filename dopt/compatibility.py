"""Which policy, model and learner make sense together, and on which system."""

from __future__ import annotations

from dopt.errors import IncompatibleError
from dopt.learning import Learner
from dopt.learning.base import Updated
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
    if isinstance(policy, Disagreement) and isinstance(learner, Updated):
        expected = "a learner of this package, which can learn for many networks"
        raise mismatch(f"policy '{policy.name}'", expected, f"learner '{learner.name}'")
    _check_model(system, policy, model)
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


def _check_model(system: System, policy: Policy, model: Model) -> None:
    given = f"policy '{policy.name}'"
    if isinstance(model, Linear) and not isinstance(policy, Informed):
        raise mismatch("model 'linear'", "policy 'oracle'", given)
    if isinstance(model, Linear) and not system.linear_parameters:
        raise mismatch("model 'linear'", "linear parameters", f"env '{system.name}'")
    form = getattr(policy, "form", "auto")
    if model.structure == "least_squares" and form not in ("auto", "primal"):
        expected = "policy.form 'primal' or 'auto'"
        raise mismatch(f"model '{model.name}'", expected, f"policy.form '{form}'")
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
