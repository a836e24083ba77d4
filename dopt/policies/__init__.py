"""How the next input is chosen: one file per policy, and the registry that names them."""

from __future__ import annotations

from dopt.policies.base import Policy
from dopt.policies.d_optimal import DOptimal
from dopt.policies.oracle import Oracle
from dopt.policies.periodic import Periodic
from dopt.policies.random import RandomGaussian, RandomHeld, RandomSphere
from dopt.policies.uniform import Uniform

POLICIES: dict[str, type[Policy]] = {
    policy.name: policy
    for policy in (RandomGaussian, RandomSphere, RandomHeld, Uniform, Periodic, DOptimal, Oracle)
}

__all__ = [
    "POLICIES",
    "DOptimal",
    "Oracle",
    "Periodic",
    "Policy",
    "RandomGaussian",
    "RandomHeld",
    "RandomSphere",
    "Uniform",
]
