"""MAX with its own planning: an agent that learns, in an ensemble's imagination, where to go."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.policies.base import CustomPolicy, Planner, check_ensemble, check_length
from dopt.systems.base import System

AGENT_UNITS = 64
"""Units of each of the two hidden layers of actor and critics."""


@dataclass(frozen=True, kw_only=True)
class ActiveExploration(CustomPolicy):
    """Apply the inputs of an agent that seeks, in imagined runs, what an ensemble disagrees on.

    The networks of the ensemble predict normal distributions of the accelerations from the features
    of the trial's model, and learn from all samples by their likelihood. Every ``replan_every``
    steps they learn on, and a soft actor-critic learns in runs that are imagined from the current
    state on, each transition by a network that is drawn for it. Its reward is the Jensen-Rényi
    divergence of the distributions at the state that is reached. The mean of the actor is then
    applied until the next plan. The trial's own model is none of these networks: any model and
    learner go with the policy.

    The agent is that of Stable-Baselines3 (the extra ``agents``). Reference: P. Shyam, W. Jaśkowski
    and F. Gomez, "Model-based active exploration" (ICML 2019), algorithm 1. There networks and
    agent are new at each plan and learn far longer; here they go on from the plan before, with the
    transitions imagined anew. :class:`dopt.policies.disagreement.Disagreement` compares held
    inputs instead.

    Parameters
    ----------
    ensemble : int
        Networks, at least 2.
    units : int
        Units of each of the two hidden layers of every network.
    warm_up : int
        First steps, in which decisions are uniform.
    replan_every : int
        Steps from one plan to the next.
    fit_updates : int
        Gradient steps of the networks at each plan.
    hold : int
        Steps for which a decision is held.
    lookahead : int
        Steps of an imagined run.
    actors : int
        Runs that are imagined at a time.
    episodes : int
        How often that is done for a plan; the agent takes a gradient step at each decision.
    learning_rate : float
        Of networks and agent.
    batch : int
        Samples and transitions of a minibatch.
    discount : float
        Discount of the reward from one decision to the next.
    entropy_weight : float
        Weight of the actor's entropy beside the reward.
    energy : str
        "below": inputs of norm γ at most; "full": always γ, along the agent's action.
    """

    name: ClassVar[str] = "max_agent"
    reads_inputs: ClassVar[bool] = False
    library: ClassVar[str] = "stable_baselines3"
    extra: ClassVar[str] = "agents"

    ensemble: int = parameter(8, "networks", "positive")
    units: int = parameter(32, "units", "positive")
    warm_up: int = parameter(25, "steps", "positive")
    replan_every: int = parameter(50, "steps", "positive")
    fit_updates: int = parameter(1000, "updates", "positive")
    hold: int = parameter(2, "steps", "positive")
    lookahead: int = parameter(50, "steps", "positive")
    actors: int = parameter(32, "runs", "positive")
    episodes: int = parameter(10, bound="positive")
    learning_rate: float = parameter(1e-3, bound="positive")
    batch: int = parameter(128, bound="positive")
    discount: float = parameter(0.95, bound="fraction")
    entropy_weight: float = parameter(0.02, bound="positive")
    energy: str = parameter("below", choices=("below", "full"), added=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ensemble(self.ensemble)

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        self.check_library()
        agents = importlib.import_module("dopt.agents.imagining_agent")  # which loads torch
        agent: Planner = agents.ImaginingAgent(self, system, rng)
        return agent
