"""Exploration by the predictive entropy of a Gaussian process, reference [8] of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.policies.held_candidates import HeldCandidates


@dataclass(frozen=True, kw_only=True)
class GaussianProcessEntropy(HeldCandidates):
    """Maximise the predictive entropy of a Gaussian process at the states that an input leads to.

    Each candidate input is held for ``lookahead`` steps of the mean prediction; its value is the
    joint entropy ½ log det(K_post + σ²/dt I) of the accelerations that would be observed there: one
    step is the predictive variance at the next state. It goes with ``model=gaussian_process`` and
    ``learner=conditioning``. Reference: M. Buisson-Fenet, F. Solowjow and S. Trimpe, "Actively
    learning Gaussian process dynamics" (L4DC 2020).
    """

    name: ClassVar[str] = "gaussian_process"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.gaussian_process.plan"
