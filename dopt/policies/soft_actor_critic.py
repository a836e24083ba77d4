"""Soft actor-critic: an agent that learns the task itself, without a model."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.control.task import Goal
from dopt.declare.validated_fields import parameter
from dopt.policies.base import Planner, TaskPolicy
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class SoftActorCritic(TaskPolicy):
    """Apply the inputs of a soft actor-critic that learns the control task of the trial.

    It is given the negative cost of the task as a reward, and nothing of the system but the
    states, in one run without resets. The trial's model learns from the same samples, so that both
    the agent's own feedback and a planner with the model can be assessed. A decision is held for
    some steps and is one transition; its reward is the mean over them.

    The agent is that of Stable-Baselines3 (the extra ``agents``). Reference: T. Haarnoja et al.,
    "Soft actor-critic algorithms and applications" (2018).

    Parameters
    ----------
    hold : int
        Steps for which an input is held.
    warm_up : int
        First steps, in which decisions are uniform.
    updates : float
        Gradient steps for each step of the trial.
    units : int
        Units of each of the two hidden layers of actor and critics.
    learning_rate : float
        Of actor, critics and the weight of the entropy, which is learned.
    batch : int
        Transitions of a minibatch.
    discount : float
        Discount of the reward from one decision to the next.
    energy : str
        "below": inputs of norm γ at most; "full": always γ, along the agent's action.
    """

    name: ClassVar[str] = "sac"
    reads_inputs: ClassVar[bool] = True
    library: ClassVar[str] = "stable_baselines3"
    extra: ClassVar[str] = "agents"

    hold: int = parameter(5, "steps", "positive")
    warm_up: int = parameter(100, "steps", "positive")
    updates: float = parameter(2.0, bound="positive")
    units: int = parameter(64, "units", "positive")
    learning_rate: float = parameter(1e-3, bound="positive")
    batch: int = parameter(128, "transitions", "positive")
    discount: float = parameter(0.98, bound="fraction")
    energy: str = parameter("below", choices=("below", "full"), added=True)

    def task_planner(self, system: System, goal: Goal, rng: np.random.Generator) -> Planner:
        self.check_library()
        agents = importlib.import_module("dopt.agents.task_agent")  # which loads torch
        agent: Planner = agents.TaskAgent(self, system, goal, rng)
        return agent
