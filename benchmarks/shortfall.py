"""How much of the exact one-step gain does the closed form of Proposition 1 miss?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.rows import Row
from dopt.reference.shortfall import Shortfall, shortfalls
from dopt.spec import TrialSpec

ENVS = ("pendulum", "cartpole", "arm", "quadrotor")


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
    one, every = shortfalls([spec.with_seed(seed) for seed in range(seeds)])
    for name, found in (("drawn component", one), ("all components", every)):
        note = f"{seeds} trials of {horizon} steps"
        yield Row(f"{env}, {name}, mean", float(found.relative.mean()), "", note=_spread(found))
        yield Row(f"{env}, {name}, median", float(np.median(found.relative)), "", note=note)


def _spread(found: Shortfall) -> str:
    missed = float(found.of_range.mean())
    return f"{missed:.2g} of what the input can change; at most {found.relative.max():.2g}"
