"""Every registered policy, learner and model, in every form of M, on both paths: none is left out.

What says that it is compiled has to agree with the reference; what does not has to be refused by
the kernel and to run on the reference.
"""

from __future__ import annotations

import numpy as np
import pytest

from dopt.algorithm import Form
from dopt.errors import SpecificationError
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
