"""Policies that choose the next input, and the registry that names them and their titles."""

from __future__ import annotations

from dopt.policies.base import InformationPolicy, Policy
from dopt.policies.d_optimal import (
    DOptimal,
    GradientDOptimal,
    GreedyLinear,
    Oracle,
    TraceLinearized,
    Uniform,
)
from dopt.policies.held_candidates import Disagreement, GaussianProcessEntropy, SpaceFilling
from dopt.policies.open_loop import (
    PRBS,
    Chirp,
    Multisine,
    Periodic,
    PeriodicSquare,
    RandomGaussian,
    RandomHeld,
    RandomSphere,
)
from dopt.policies.search import (
    ICEM,
    AOptimal,
    EOptimal,
    Episodic,
    Exact,
    Lookahead,
    Search,
    TaskOptimal,
    Trace,
)

TITLES: dict[str, str] = {
    "d_optimal": "D-optimal",
    "oracle": "oracle",
    "uniform": "uniform",
    "periodic": "periodic",
    "random": "random",
    "random_held": "held random",
    "random_sphere": "random on the sphere",
    "prbs": "PRBS",
    "multisine": "multisine",
    "chirp": "chirp",
    "periodic_square": "periodic, square wave",
    "max": "ensemble disagreement",
    "gaussian_process": "Gaussian process",
    "gradient": "D-optimal, by gradient",
    "linear": "D-optimal, linear",
    "lookahead": "look-ahead",
    "icem": "iCEM",
    "episodic": "episodic plans",
    "exact": "exact gain",
    "trace": "trace",
    "trace_linearized": "trace, linearised",
    "a_optimal": "A-optimal",
    "e_optimal": "E-optimal",
    "task": "task-optimal",
    "space_filling": "space filling",
}
"""The policies of the paper come first; a user's own policy follows by its name."""


def policy_title(policy: str) -> str:
    """Return the title of a policy; without an entry, its name with spaces."""
    return TITLES.get(policy, policy.replace("_", " "))


POLICIES: dict[str, type[Policy]] = {
    policy.name: policy
    for policy in (
        RandomGaussian,
        RandomSphere,
        RandomHeld,
        PRBS,
        Multisine,
        Chirp,
        PeriodicSquare,
        Uniform,
        Periodic,
        DOptimal,
        Oracle,
        TraceLinearized,
        Exact,
        Trace,
        AOptimal,
        EOptimal,
        TaskOptimal,
        Lookahead,
        ICEM,
        Episodic,
        Disagreement,
        GaussianProcessEntropy,
        GradientDOptimal,
        GreedyLinear,
        SpaceFilling,
    )
}

__all__ = [
    "ICEM",
    "POLICIES",
    "PRBS",
    "AOptimal",
    "Chirp",
    "DOptimal",
    "Disagreement",
    "EOptimal",
    "Episodic",
    "Exact",
    "GaussianProcessEntropy",
    "GradientDOptimal",
    "GreedyLinear",
    "InformationPolicy",
    "Lookahead",
    "Multisine",
    "Oracle",
    "Periodic",
    "PeriodicSquare",
    "Policy",
    "RandomGaussian",
    "RandomHeld",
    "RandomSphere",
    "Search",
    "SpaceFilling",
    "TaskOptimal",
    "Trace",
    "TraceLinearized",
    "Uniform",
]
