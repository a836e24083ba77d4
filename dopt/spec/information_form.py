"""Information matrix of a trial: that of the planner or of the learner, and its form."""

from __future__ import annotations

from typing import NamedTuple, TypeGuard

from dopt.learning import InformationLearner, Learner, RecursiveLeastSquares
from dopt.policies import InformationPolicy, Policy


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
    policy: Policy, learner: Learner, n_parameters: int, n_rows: int
) -> Information | None:
    """Return what M a trial holds for q parameters and N rows; None where nothing needs one.

    A policy that plans by M shares it with a learner that updates it, which needs the gain in the
    space of the parameters and hence the primal form.
    """
    sharing = learner if isinstance(learner, (InformationLearner, RecursiveLeastSquares)) else None
    noise_variance = sharing.noise_variance if isinstance(sharing, InformationLearner) else 1.0
    if isinstance(policy, InformationPolicy):
        form = "primal" if sharing else policy.chosen_form(n_parameters, n_rows)
        return Information(form, policy.regularization, noise_variance)
    return Information("primal", sharing.regularization, noise_variance) if sharing else None


def is_fresh(policy: Policy) -> TypeGuard[InformationPolicy]:
    """Tell whether M is summed from the rows of all states at the present parameters."""
    return isinstance(policy, InformationPolicy) and policy.information == "fresh"
