"""Trials with every registered policy, learner and model, in every form of M.

They come from the registries: what is registered later is among them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

from dopt.algorithm import Form
from dopt.errors import IncompatibleError
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import SMALL_GRIDS, SMALL_SEARCHES

ENVS = ("arm", "mass_spring", "pendulum")
"""Systems of which the first one that a choice fits is taken."""

FORMS = [form.name.lower() for form in Form]
SMALL: dict[str, dict[str, Any]] = {
    **SMALL_SEARCHES,
    "adam_replay": {"capacity": 5, "batch": 4, "steps": 2},
    "adam_window": {"window": 4},
    "ekf": {"forgetting": 0.98},
    "joint_ekf": {"refit_every": 4, "steps": 2},
}
MEASURED = {"measured_states": [0, 1], "measurement_noise": [0.01, 0.01]}
"""Sensors for learners that estimate states."""


def combined(env: str, policy: str, model: str, learner: str, form: str) -> TrialSpec | None:
    """Return the trial of some choices; None where they do not go together."""
    chosen = {"policy": policy, "model": model, "learner": learner}
    sections = {key: {"name": name, **SMALL.get(name, {})} for key, name in chosen.items()}
    if form != "auto":
        sections["policy"] |= {"form": form, "sketch_size": 48}
    grid = {"name": env, "horizon": 9, "grid_points": list(SMALL_GRIDS[env])}
    if LEARNERS[learner].estimates_states:
        grid |= MEASURED
        if hasattr(POLICIES[policy], "regularization"):
            sections["policy"] |= {"regularization": 3.0}
    try:
        return TrialSpec.from_mapping({"env": grid, **sections, "seed": 3})
    except IncompatibleError:
        return None


def first_fitting(env_policies: list[tuple[str, str]], learner: str, form: str) -> TrialSpec | None:
    found = (
        combined(env, policy, model, learner, form)
        for env, policy in env_policies
        for model in MODELS
    )
    return next((spec for spec in found if spec is not None), None)


def cases() -> Iterator[tuple[str, TrialSpec]]:
    """Yield every learner in every form of M that a policy with it can hold, and every policy."""
    forms = [name for name in POLICIES if hasattr(POLICIES[name], "sketch_size")]
    for learner in LEARNERS:
        for form in FORMS:
            spec = first_fitting([(env, name) for env in ENVS for name in forms], learner, form)
            if spec is not None:
                yield f"{learner}-{form}", spec
        spec = first_fitting([(env, name) for env in ENVS for name in POLICIES], learner, "auto")
        assert spec is not None, f"learner '{learner}' goes with no policy and model"
        yield learner, spec
    for policy in POLICIES:
        fitting = (
            first_fitting([(env, policy)], learner, "auto") for env in ENVS for learner in LEARNERS
        )
        spec = next((one for one in fitting if one is not None), None)
        assert spec is not None, f"policy '{policy}' goes with no model and learner"
        yield policy, spec
    for model in MODELS:
        pairs = itertools.product(ENVS, POLICIES, LEARNERS)
        made = (combined(env, policy, model, learner, "auto") for env, policy, learner in pairs)
        spec = next((one for one in made if one is not None), None)
        assert spec is not None, f"model '{model}' goes with no policy and learner"
        yield f"model-{model}", spec


CASES = dict(cases())
"""A trial for every choice, by the name of the choice."""
