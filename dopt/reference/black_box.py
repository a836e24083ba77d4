"""Episodes of systems without equations, stepped trial by trial for a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dopt.randomness import episode_seed
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import BlackBox, Episode, new_start


def episodes_for(specs: Sequence[TrialSpec]) -> list[Episode]:
    """Return the run of each trial, started from its seed; none for a system with equations."""
    system = specs[0].system
    if not isinstance(system, BlackBox):
        return []
    return [system.episode(episode_seed(spec.seed)) for spec in specs]


def initial_states(episodes: Sequence[Episode]) -> Tensor:
    """Return x_0 of every run, (n, d)."""
    return torch.tensor(np.stack([episode.state for episode in episodes]))


def stepped(episodes: Sequence[Episode], x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Apply inputs (n, m); return what was applied, (n, m), and the next states, (n, d).

    Where a run has begun anew, the state before the step, in x (n, d), becomes its start.
    """
    inputs = u.cpu().numpy()
    applied = [episode.step(row) for episode, row in zip(episodes, inputs, strict=True)]
    for row, episode in zip(x, episodes, strict=True):
        if (start := new_start(episode)) is not None:
            row.copy_(torch.tensor(start))
    states = [episode.state for episode in episodes]
    return torch.tensor(np.stack(applied)).to(u), torch.tensor(np.stack(states)).to(u)
