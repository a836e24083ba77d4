"""A small grid of coupled pendulums, really run."""

from __future__ import annotations

from typing import Any

from dopt.spec.trial import TrialSpec
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial

LEARNED: dict[str, dict[str, Any]] = {
    "model": {"name": "linear"},
    "learner": {"name": "ekf", "regularization": 1e-8},
}


def pendulums(policy: str, n: int, seed: int, **env: object) -> TrialSpec:
    planned: dict[str, Any] = {"regularization": 1e-8} if policy == "d_optimal" else {}
    fields = {"n_pendulums": n, "horizon": 40, **env}
    return trial("coupled_pendulums", policy, seed, env=fields, policy=planned, **LEARNED)


SPECS = [
    pendulums(policy, n, seed)
    for policy in ("d_optimal", "random")
    for n in (1, 2)
    for seed in range(3)
]


def fill_small_grid(address: str) -> None:
    """Run the trials and store them."""
    fill(address, SPECS, edit=simulated)
