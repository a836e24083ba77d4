"""Exploration by the disagreement of an ensemble of networks (MAX), reference [10] of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.policies.base import check_ensemble
from dopt.policies.held_candidates import HeldCandidates


@dataclass(frozen=True, kw_only=True)
class Disagreement(HeldCandidates):
    """Maximise how much networks with other initial weights disagree about where the input leads.

    K networks learn from the same samples by the same learner. The trial's own network is the first
    of them and is what the loss evaluates: the paper compares policies at one model f_θ. The others
    serve the plan alone, and their initial weights come from a stream of their own.

    Each candidate input is held for ``lookahead`` steps of the mean prediction of the ensemble; its
    value is the sum, over the states visited and the learned components, of the variance across the
    ensemble of the accelerations predicted there. One step already leads to the next state: what is
    predicted *at* x_t does not depend on u_t, for the input term is known.

    The variance stands for the Jensen-Rényi divergence of the original: with networks that predict
    a mean, and noise as small as it is here, each network is far outside the others' noise, where
    that divergence is log K for every input. Reference: P. Shyam, W. Jaśkowski and F. Gomez,
    "Model-based active exploration" (ICML 2019).

    Parameters
    ----------
    ensemble : int
        K, networks in all, at least 2.
    lookahead, candidates
        As of :class:`dopt.policies.held_candidates.HeldCandidates`.
    """

    name: ClassVar[str] = "max"
    compiled: ClassVar[bool] = False

    ensemble: int = parameter(5, "networks", "positive")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ensemble(self.ensemble)
