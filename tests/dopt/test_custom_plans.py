"""Closed-loop policies and learners of a user's own, and of the package beside the kernel."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.reference.batch import run_trials
from dopt.run import run_trial
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from tests.paths import ROOT

HERE = "tests.dopt.custom_plugins"


def specification(seed: int = 0, **sections: dict[str, Any]) -> TrialSpec:
    usual: dict[str, Any] = {
        "env": {"name": "pendulum", "horizon": 25, "grid_points": [4, 4]},
        "policy": {"name": "d_optimal"},
        "model": {"name": "mlp"},
        "learner": {"name": "adam"},
    }
    return TrialSpec.from_mapping(usual | sections | {"seed": seed})


def own(name: str, **fields: Any) -> dict[str, Any]:
    return {"_target_": f"{HERE}.{name}", **fields}


def test_a_plan_in_numpy_repeats_algorithm_2() -> None:
    plain = run_trial(specification(policy=own("Copy")))
    shipped = run_trial(specification(), path="reference")
    np.testing.assert_allclose(plain.inputs, shipped.inputs, atol=1e-12)
    np.testing.assert_allclose(plain.loss, shipped.loss, rtol=1e-9)


def test_an_update_in_numpy_repeats_adam() -> None:
    plain = run_trial(specification(learner=own("Descent")))
    shipped = run_trial(specification(), path="reference")
    np.testing.assert_allclose(plain.states, shipped.states, rtol=1e-9)
    np.testing.assert_allclose(plain.parameters, shipped.parameters, rtol=1e-9)


def test_trials_in_lockstep_are_those_run_alone() -> None:
    specs = [specification(seed, policy=own("Coin")) for seed in range(3)]
    together, alone = run_trials(specs), [run_trial(spec) for spec in specs]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one.states, other.states, rtol=1e-9)
    assert not np.array_equal(alone[0].inputs, alone[1].inputs)
    np.testing.assert_array_equal(alone[0].inputs, run_trial(specs[0]).inputs)


def test_what_the_kernel_lacks_runs_on_the_reference_by_itself() -> None:
    assert specification().config.path == "kernel"
    assert specification(policy=own("Coin")).config.path == "reference"
    assert specification(learner=own("Descent")).config.path == "reference"
    spec = specification(policy=own("Coin"))
    assert TrialSpec.from_mapping(spec.to_mapping()).trial_key == spec.trial_key


def test_the_kernel_refuses_what_it_lacks() -> None:
    config = specification(policy=own("Coin")).config
    with pytest.raises(SpecificationError, match="policy 'coin' is not written for it"):
        dataclasses.replace(config, path="kernel")
    mapping = specification(learner=own("Descent")).to_mapping()
    with pytest.raises(SpecificationError, match="learner 'descent' is not written for it"):
        TrialSpec.from_mapping(mapping | {"path": "kernel"})


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"scale": 2.0}, "chose an input of norm 4 at step 5, but env.gamma is 2: scale it down"),
        ({"size": 2}, r"chose an input of shape \(2,\) at step 1, but \(1,\) is expected"),
    ],
)
def test_an_input_out_of_bounds_is_refused(fields: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        run_trial(specification(policy=own("Wild", **fields)))


def test_an_update_of_another_size_is_refused() -> None:
    with pytest.raises(SpecificationError, match="learner 'descent' returned parameters of shape"):
        run_trial(specification(learner=own("Descent", extra=1)))


def test_a_plan_that_gets_lost_ends_its_trial_alone() -> None:
    result = run_trial(specification(policy=own("Lost")))
    assert result.diverged_at == 5
    assert np.isfinite(result.loss[:5]).all()
    assert np.isnan(result.loss[5:]).all()


def test_a_config_of_own_parts_is_a_value() -> None:
    first, second = (specification(policy=own("Coin")).config for _ in range(2))
    assert isinstance(first, TrialConfig)
    assert first == second
    assert hash(first) == hash(second)


def test_torch_is_loaded_where_a_trial_runs_and_no_sooner() -> None:
    """The driver of a grid only makes the specification, and sends it to its workers."""
    mapping = specification(policy=own("Coin"), learner=own("Descent")).to_mapping()
    program = (
        "import pickle, sys; from dopt.spec.trial import TrialSpec; "
        f"spec = TrialSpec.from_mapping({mapping!r}); pickle.dumps(spec); spec.trial_key; "
        "assert 'torch' not in sys.modules; "
        "from dopt.run import run_trial; run_trial(spec); assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)
