"""Small trials for tests: named choices, few evaluation points, short horizons and plans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dopt.errors import IncompatibleError
from dopt.offline_fit import Samples
from dopt.policies import POLICIES
from dopt.policies.base import ball_norms, on_sphere
from dopt.randomness import process_noise, stream
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS

AXES = {name: len(system().grid_points) for name, system in SYSTEMS.items()}
SMALL_GRIDS = {name: {1: (16,), 2: (4, 4)}.get(axes, (2,) * axes) for name, axes in AXES.items()}
SMALL_GRIDS |= dict.fromkeys(("cartpole", "cartpole_unknown_gain"), (3, 4, 3))
SMALL_SEARCHES = {"lookahead": {"lookahead": 6, "candidates": 4}, "task": {"count": 8}}
SMALL_SEARCHES |= {"icem": {"lookahead": 6, "hold": 2, "stride": 2, "plans": 8, "elites": 3}}
SMALL_SEARCHES |= {"episodic": SMALL_SEARCHES["icem"] | {"replan_every": 5}}
SIZES = {"chain": {"n_links": 3}, "coupled_pendulums": {"n_pendulums": 3}}
"""Systems of any size: as small as an end, a middle and a start can be."""
MODELS = {"oracle": "linear", "linear": "linear_state", "gaussian_process": "gaussian_process"}
LEARNERS = {"oracle": "recursive_least_squares", "linear": "recursive_least_squares"}
LEARNERS |= {"gaussian_process": "conditioning"}


def trial(env: str, policy: str, seed: int = 0, /, **fields: Mapping[str, Any]) -> TrialSpec:
    """Return a small trial; ``fields`` are the entries of the sections that differ from that."""
    sections: dict[str, dict[str, Any]] = {
        "env": {"name": env, "horizon": 30, "grid_points": SMALL_GRIDS[env], **SIZES.get(env, {})},
        "policy": {"name": policy, **SMALL_SEARCHES.get(policy, {})},
        "model": {"name": MODELS.get(policy, "affine" if SYSTEMS[env].reads_inputs else "mlp")},
        "learner": {"name": LEARNERS.get(policy, "adam_window")},
    }
    merged = {key: section | dict(fields.get(key, {})) for key, section in sections.items()}
    return TrialSpec.from_mapping(merged | {"seed": seed})


def compatible(env: str, policy: str) -> bool:
    """Return whether a policy makes sense for a system."""
    try:
        trial(env, policy)
    except IncompatibleError:
        return False
    return True


KNOWN_EFFECT = [env for env, system in SYSTEMS.items() if not system.reads_inputs]
"""Systems of which the effect of the inputs is known; tests of input models have the others."""

ALL_PAIRS = [
    (env, policy) for env in KNOWN_EFFECT for policy in POLICIES if compatible(env, policy)
]


def covering(pairs: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return few of the pairs, in which each of their systems and policies occurs."""
    systems, policies = ({pair[i] for pair in pairs} for i in (0, 1))
    chosen: list[tuple[str, str]] = []
    while systems or policies:
        best = max(pairs, key=lambda pair: (pair[0] in systems) + (pair[1] in policies))
        chosen.append(best)
        systems.discard(best[0])
        policies.discard(best[1])
    return chosen


PAIRS = [pair for pair in ALL_PAIRS if trial(*pair).config.path == "kernel"]
"""Pairs of a system and a policy that the kernel runs; the others run on the reference alone."""


def uniform_samples(spec: TrialSpec) -> Samples:
    """Return as many samples as a trial has steps, at states drawn uniformly from its grid's box.

    The noise is the trial's, w_t of equation 2. One step from a state x under any input is
    observed as y = a(x) + w/dt in the learned rows: the known part, and with it the input, cancels.
    Where the effect of the inputs is learned, they are drawn uniformly from the sphere ‖u‖ = γ, or
    from the ball within for a model that is not affine in them.
    State components without an axis in the grid are zero, as they are there. Of a system that
    changes, the accelerations belong to the last step, by which the final loss is judged.
    """
    system, rng = spec.system, stream(spec.seed, "uniform_states")
    states = np.zeros((system.horizon, system.n_states))
    for index, (low, high) in system.grid_box().items():
        states[:, index] = rng.uniform(low, high, system.horizon)
    inputs = on_sphere(rng.standard_normal((system.horizon, system.n_inputs)), system.gamma)
    if not spec.model.affine_in_inputs:
        inputs *= ball_norms(rng, (len(inputs), 1), system.n_inputs)
    noise = process_noise(system, spec.seed)[:, list(system.learned_rows)] / system.dt
    accelerations = system.learned(states, system.horizon - 1, inputs)
    return Samples(states, inputs, accelerations + noise)
