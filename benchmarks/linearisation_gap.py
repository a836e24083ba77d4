"""How far the closed form of Proposition 1 falls short of the optimum that it approximates.

At every step of trials with the D-optimal policy, the exact gain of Definition 1 is evaluated at
the input that was chosen and maximised over the sphere, both for the component k that was drawn,
which is what the proposition linearises, and for all learned components together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from dopt.policies.gradient import GradientDOptimal
from dopt.reference.exact_gain import ExactGain, Situation, candidates
from dopt.reference.lockstep import Lockstep
from dopt.spec import TrialSpec

Array = npt.NDArray[np.float64]

SEARCH = GradientDOptimal(candidates=64, starts=3, iterations=6)


@dataclass(frozen=True)
class Shortfall:
    """Exact gains over the planned steps t = 1 ... T-1 of n trials, (n, T - 1) each.

    Attributes
    ----------
    chosen : array
        At the input that the closed form chose.
    best : array
        The largest on the sphere; not less than ``chosen``, from where the search starts as well.
    least : array
        The smallest of the candidates: what a bad input would have gained.
    """

    chosen: Array
    best: Array
    least: Array

    @property
    def relative(self) -> Array:
        """Share of the largest gain that was missed."""
        return (self.best - self.chosen) / self.best

    @property
    def of_range(self) -> Array:
        """The same as a share of what the input can change at all, best - least."""
        spread = self.best - self.least
        return (self.best - self.chosen) / np.where(spread > 0.0, spread, 1.0)


@torch.no_grad()
def shortfalls(
    specs: Sequence[TrialSpec], search: GradientDOptimal = SEARCH
) -> tuple[Shortfall, Shortfall]:
    """Run trials of one D-optimal cell; return what they missed of one component and of all."""
    batch = Lockstep(specs)
    assert batch.information is not None, "the policy plans with an information matrix"
    single, whole = ExactGain(batch, single=True), ExactGain(batch)
    given = candidates(batch, search)
    found: list[tuple[Tensor, Tensor]] = []
    for t in range(batch.system.horizon):
        covariance = torch.linalg.inv(batch.information)
        now = Situation(batch.theta.clone(), covariance, batch.states[:, t], batch.components[:, t])
        batch.step(t)
        if t > 0:
            start = torch.cat([batch.inputs[:, t].unsqueeze(1), given], dim=1)
            found.append((_gains(single, start, now, search), _gains(whole, start, now, search)))
    return _shortfall([one for one, _ in found]), _shortfall([every for _, every in found])


def _gains(gain: ExactGain, start: Tensor, now: Situation, search: GradientDOptimal) -> Tensor:
    """Return the gains at the first start, at the optimum and at the worst start, (n, 3)."""
    values = gain.values(start, now)
    best = gain.values(gain.optimum(start, now, search).unsqueeze(1), now)[:, 0]
    return torch.stack([values[:, 0], torch.maximum(best, values.amax(1)), values.amin(1)], dim=-1)


def _shortfall(gains: list[Tensor]) -> Shortfall:
    return Shortfall(*(rows.numpy() for rows in torch.stack(gains, dim=1).unbind(-1)))
