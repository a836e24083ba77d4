"""Policies that choose the next input, one file for each, and the registry that names them."""

from __future__ import annotations

from dopt.policies.a_optimal import AOptimal
from dopt.policies.base import InformationPolicy, Policy
from dopt.policies.chirp import Chirp
from dopt.policies.d_optimal import DOptimal
from dopt.policies.disagreement import Disagreement
from dopt.policies.e_optimal import EOptimal
from dopt.policies.episodic import Episodic
from dopt.policies.exact import Exact
from dopt.policies.gaussian_process import GaussianProcessEntropy
from dopt.policies.gradient import GradientDOptimal
from dopt.policies.greedy_linear import GreedyLinear
from dopt.policies.icem import ICEM
from dopt.policies.lookahead import Lookahead
from dopt.policies.multisine import Multisine
from dopt.policies.oracle import Oracle
from dopt.policies.periodic import Periodic, PeriodicSquare
from dopt.policies.prbs import PRBS
from dopt.policies.random import RandomGaussian, RandomHeld, RandomSphere
from dopt.policies.search import Search
from dopt.policies.space_filling import SpaceFilling
from dopt.policies.task import TaskOptimal
from dopt.policies.trace import Trace
from dopt.policies.trace_linearized import TraceLinearized
from dopt.policies.uniform import Uniform

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
