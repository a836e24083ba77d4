"""Every registered policy, learner and model, in every form of M, on both paths: none is left out.

The cases come from the registries. What says that it is compiled has to agree with the reference;
what does not has to be refused by the kernel and to run on the reference.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from dopt.algorithm import Form
from dopt.errors import IncompatibleError, SpecificationError
from dopt.learning import LEARNERS
from dopt.learning.base import Learner
from dopt.models import MODELS
from dopt.models.base import Model
from dopt.policies import POLICIES
from dopt.policies.base import Policy
from dopt.run import run_trial
from dopt.spec.information_form import held_information
from dopt.spec.trial import TrialSpec
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.newcomers import Alternating, Average
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


@pytest.mark.parametrize("name", CASES)
def test_both_paths_agree_or_the_kernel_refuses(name: str) -> None:
    spec = CASES[name]
    plain = run_trial(spec, "reference")
    assert np.isfinite(plain.loss).all()
    if spec.config.path == "reference":
        with pytest.raises(SpecificationError, match="path is 'kernel', but"):
            run_trial(spec, "kernel")
        return
    fast = run_trial(spec, "kernel")
    # Derivatives by a state are differences in the kernel.
    expected = 1e-6 if spec.learner.estimates_states else 1e-8
    assert relative_gap(fast.inputs, plain.inputs) < expected
    # Least squares of the reference squares the condition.
    least_squares = spec.learner.structure == "least_squares"
    expected = 1e-5 if least_squares else expected
    assert relative_gap(fast.parameters, plain.parameters) < expected


def test_the_cases_cover_the_registries_and_the_forms() -> None:
    specs = list(CASES.values())
    assert {spec.policy.name for spec in specs} == set(POLICIES)
    assert {spec.learner.name for spec in specs} == set(LEARNERS)
    assert {spec.model.name for spec in specs} == set(MODELS)
    held = {
        held_information(spec.policy, spec.learner, 1, 1)
        for spec in specs
        if spec.config.path == "kernel"
    }
    assert {one.form for one in held if one is not None} == set(FORMS)


@pytest.mark.parametrize("registry", [POLICIES, LEARNERS, MODELS])
def test_every_class_says_whether_it_is_compiled(
    registry: dict[str, type[Policy | Learner | Model]],
) -> None:
    for name, cls in registry.items():
        declaring = next(base for base in cls.__mro__ if "compiled" in base.__dict__)
        assert declaring is cls or "name" not in declaring.__dict__, name


def test_a_new_policy_or_learner_is_four_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its class, with a twin in numpy, its kernel function and its line in the registry run it.

    The fourth file is its option under conf/, which only names it. No dispatch, no structure and no
    other path has to know of it.
    """
    monkeypatch.setitem(POLICIES, "alternating", Alternating)
    monkeypatch.setitem(LEARNERS, "average", Average)
    spec = combined("arm", "alternating", "mlp", "average", "auto")
    assert spec is not None
    assert spec.config.path == "kernel"
    fast, plain = run_trial(spec), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-12
    assert relative_gap(fast.parameters, plain.parameters) < 1e-8
