"""How the next input is chosen: one file per policy, and the registry that names them."""

from __future__ import annotations

from dopt.policies.base import Informed, Policy
from dopt.policies.chirp import Chirp
from dopt.policies.d_optimal import DOptimal
from dopt.policies.multisine import Multisine
from dopt.policies.oracle import Oracle
from dopt.policies.periodic import Periodic
from dopt.policies.prbs import PRBS
from dopt.policies.random import RandomGaussian, RandomHeld, RandomSphere
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
        Uniform,
        Periodic,
        DOptimal,
        Oracle,
    )
}

__all__ = [
    "POLICIES",
    "PRBS",
    "Chirp",
    "DOptimal",
    "Informed",
    "Multisine",
    "Oracle",
    "Periodic",
    "Policy",
    "RandomGaussian",
    "RandomHeld",
    "RandomSphere",
    "Uniform",
]
