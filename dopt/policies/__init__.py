"""Policies that choose the next input, and the registry that names them and their titles."""

from __future__ import annotations

from dopt.policies.base import InformationPolicy as InformationPolicy
from dopt.policies.base import Policy as Policy
from dopt.policies.d_optimal import DOptimal as DOptimal
from dopt.policies.d_optimal import GradientDOptimal as GradientDOptimal
from dopt.policies.d_optimal import GreedyLinear as GreedyLinear
from dopt.policies.d_optimal import Oracle as Oracle
from dopt.policies.d_optimal import TraceLinearized as TraceLinearized
from dopt.policies.d_optimal import Uniform as Uniform
from dopt.policies.held_candidates import Disagreement as Disagreement
from dopt.policies.held_candidates import GaussianProcessEntropy as GaussianProcessEntropy
from dopt.policies.held_candidates import SpaceFilling as SpaceFilling
from dopt.policies.open_loop import PRBS as PRBS
from dopt.policies.open_loop import Chirp as Chirp
from dopt.policies.open_loop import Multisine as Multisine
from dopt.policies.open_loop import Periodic as Periodic
from dopt.policies.open_loop import PeriodicSquare as PeriodicSquare
from dopt.policies.open_loop import RandomGaussian as RandomGaussian
from dopt.policies.open_loop import RandomHeld as RandomHeld
from dopt.policies.open_loop import RandomSphere as RandomSphere
from dopt.policies.search import ICEM as ICEM
from dopt.policies.search import AOptimal as AOptimal
from dopt.policies.search import EOptimal as EOptimal
from dopt.policies.search import Episodic as Episodic
from dopt.policies.search import Exact as Exact
from dopt.policies.search import Lookahead as Lookahead
from dopt.policies.search import Search as Search
from dopt.policies.search import TaskOptimal as TaskOptimal
from dopt.policies.search import Trace as Trace

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
