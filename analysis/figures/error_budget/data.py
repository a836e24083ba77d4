"""Error budgets: floor, factor of exploration and factor of the learner, over trials.

The loss of a trial is a product of three numbers,

    online = floor · (offline / floor) · (online / offline),

where *floor* is the loss of the same network fitted offline to samples that are spread uniformly
over the evaluation box, *offline* that of a fit to the samples which the policy has recorded, and
*online* that of the trial. The first quotient is what exploration loses, the second what the
learner loses. Geometric means over the same trials multiply in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from analysis.stats.geometric_means import Estimate, geometric_mean

PARTS = ("floor", "exploration_factor", "offline", "learner_factor", "online")
"""Columns of a budget, in the order in which they multiply: the third and last are products."""


@dataclass(frozen=True)
class Budget:
    """Error budget of one configuration.

    Attributes
    ----------
    n : int
        Trials that did not diverge.
    n_unconverged : int
        Those of which a fit ended without having converged.
    floor, offline, online : Estimate
        Losses, in units of the learned accelerations.
    exploration_factor, learner_factor : Estimate
        offline / floor and online / offline.
    """

    env: str
    policy: str
    label: str
    n: int
    n_unconverged: int
    floor: Estimate
    exploration_factor: Estimate
    offline: Estimate
    learner_factor: Estimate
    online: Estimate


def budgets(trials: pd.DataFrame) -> tuple[Budget, ...]:
    """Return the budget of every configuration, from one row for each trial.

    The rows are those of :func:`analysis.floor.trial_fits.fit_trials`.
    """
    groups = trials.groupby(["env", "policy", "label"], sort=False)
    return tuple(_budget(rows) for _, rows in groups)


def _budget(rows: pd.DataFrame) -> Budget:
    env, policy, label = (str(rows[name].iloc[0]) for name in ("env", "policy", "label"))
    unconverged = ~(rows["floor_converged"] & rows["offline_converged"])
    parts = {name: geometric_mean(rows[name].to_numpy(float)) for name in PARTS}
    return Budget(env, policy, label, len(rows), int(unconverged.sum()), **parts)


def tabulate(found: tuple[Budget, ...]) -> pd.DataFrame:
    """Return one row for each configuration, exactly what is drawn."""
    return pd.DataFrame([_row(budget) for budget in found])


def _row(budget: Budget) -> dict[str, object]:
    row: dict[str, object] = {
        name: getattr(budget, name) for name in ("env", "policy", "label", "n", "n_unconverged")
    }
    for name in PARTS:
        part: Estimate = getattr(budget, name)
        row |= {name: part.value, f"{name}_low": part.low, f"{name}_high": part.high}
    return row
