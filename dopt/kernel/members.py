"""Members of an ensemble in compiled code (:class:`dopt.models.Ensemble`)."""

from __future__ import annotations

from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Learn, Trial
from dopt.types import Matrix, Vector


@compiled
def members_or_one(state: State) -> Matrix:
    """Return the parameters whose mean prediction is evaluated, (E, q), as a view."""
    if state.members.parameters.shape[0] > 0:
        return state.members.parameters
    return state.theta.reshape(1, state.theta.shape[0])


@compiled
def learn_members(trial: Trial, learn: Learn, t: int, target: Vector) -> None:
    """Let the member whose turn it is learn, and then the first one, whose M stays.

    θ and θ₀ of the state are those of the first before and after.
    """
    state = trial.state
    members, priors = state.members.parameters, state.members.priors
    if members.shape[0] > 0:
        turn = 1 + t % (members.shape[0] - 1)
        copy_into(members[turn], state.theta)
        copy_into(priors[turn], state.prior)
        learn(trial, t, target)
        copy_into(state.theta, members[turn])
        copy_into(members[0], state.theta)
        copy_into(priors[0], state.prior)
    learn(trial, t, target)
    if members.shape[0] > 0:
        copy_into(state.theta, members[0])
