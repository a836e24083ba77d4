"""Gap between the closed form of Proposition 1 and the optimum that it approximates.

At every step of trials with the D-optimal policy, the exact gain of Definition 1 is evaluated at
the input that was chosen and maximised over the sphere, both for the component k that was drawn,
which is what the proposition linearises, and for all learned components together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from benchmarks.rows import Row
from dopt.policies.gradient import GradientDOptimal
from dopt.reference.batch import Lockstep
from dopt.reference.exact_gain import ExactGain, Situation, candidates
from dopt.spec.trial import TrialSpec

Array = npt.NDArray[np.float64]

ENVS = ("pendulum", "cartpole", "arm", "quadrotor")
SEARCH = GradientDOptimal(candidates=64, starts=3, iterations=6)


@dataclass(frozen=True)
class LinearisationGap:
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
def linearisation_gaps(
    specs: Sequence[TrialSpec], search: GradientDOptimal = SEARCH
) -> tuple[LinearisationGap, LinearisationGap]:
    """Run trials of one D-optimal configuration; return the gaps of one component and of all."""
    batch = Lockstep(specs)
    assert batch.information is not None, "the policy plans with an information matrix"
    single, whole = ExactGain(batch, single=True), ExactGain(batch)
    given = candidates(batch, search)
    found: list[tuple[Tensor, Tensor]] = []
    for t in range(batch.system.horizon):
        covariance = batch.information.covariance().clone()
        now = Situation(batch.theta.clone(), covariance, batch.states[:, t], batch.components[:, t])
        batch.step(t)
        if t > 0:
            start = torch.cat([batch.inputs[:, t].unsqueeze(1), given], dim=1)
            found.append((_gains(single, start, now, search), _gains(whole, start, now, search)))
    return _gap([one for one, _ in found]), _gap([every for _, every in found])


def _gains(gain: ExactGain, start: Tensor, now: Situation, search: GradientDOptimal) -> Tensor:
    """Return the gains at the first start, at the optimum and at the worst start, (n, 3)."""
    values = gain.values(start, now)
    best = gain.values(gain.optimum(start, now, search).unsqueeze(1), now)[:, 0]
    return torch.stack([values[:, 0], torch.maximum(best, values.amax(1)), values.amin(1)], dim=-1)


def _gap(gains: list[Tensor]) -> LinearisationGap:
    return LinearisationGap(*(rows.numpy() for rows in torch.stack(gains, dim=1).unbind(-1)))


def measure(quick: bool) -> list[Row]:
    """Return shares of the largest gain that D-optimal inputs missed, by system.

    The gain is that of the drawn component, which is linearised, and that of all components.
    """
    seeds, horizon = (1, 6) if quick else (4, 100)
    return [row for env in ENVS for row in _rows(env, seeds, horizon)]


def _rows(env: str, seeds: int, horizon: int) -> Iterator[Row]:
    names = {"policy": "d_optimal", "model": "mlp", "learner": "adam_window"}
    sections = {key: {"name": name} for key, name in names.items()}
    spec = TrialSpec.from_mapping(
        {"env": {"name": env, "horizon": horizon}, **sections, "path": "reference"}
    )
    one, every = linearisation_gaps([spec.with_seed(seed) for seed in range(seeds)])
    for name, found in (("drawn component", one), ("all components", every)):
        note = f"{seeds} trials of {horizon} steps"
        yield Row(f"{env}, {name}, mean", float(found.relative.mean()), "", note=_spread(found))
        yield Row(f"{env}, {name}, median", float(np.median(found.relative)), "", note=note)


def _spread(found: LinearisationGap) -> str:
    missed = float(found.of_range.mean())
    return f"{missed:.2g} of what the input can change; at most {found.relative.max():.2g}"
