"""Every registered policy, learner and model, in every form of M, runs: none is left out."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.algorithm import Form
from dopt.errors import IncompatibleError
from dopt.learning import LEARNERS
from dopt.learning.base import Learner
from dopt.models import MODELS
from dopt.models.base import Model
from dopt.policies import POLICIES
from dopt.policies.base import Policy
from dopt.run import run_trial
from dopt.spec.compatibility import held_information
from tests.dopt.every_choice import CASES, combined
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.newcomers import Alternating, Average


@pytest.mark.parametrize("name", CASES)
def test_every_choice_runs_and_agrees_where_both_paths_run_it(name: str) -> None:
    spec = CASES[name]
    fast = run_trial(spec)
    assert np.isfinite(fast.loss).all()
    try:
        plain = run_trial(spec, "reference")
    except IncompatibleError as error:
        assert "runs in the compiled kernel alone" in str(error)  # noqa: PT017  # the rest agrees
        return
    # An ascent may end on a flat top, where inputs are known to the root of the rounding.
    expected = 1e-6 if spec.policy.name == "gradient" else 1e-8
    assert relative_gap(fast.inputs, plain.inputs) < expected
    # Least squares of the reference squares the condition.
    expected = 1e-5 if spec.learner.structure == "least_squares" else expected
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
    assert {one.form for one in held if one is not None} == {form.name.lower() for form in Form}


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
