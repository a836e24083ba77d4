"""Networks of a user's own as models."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dopt.errors import IncompatibleError, SpecificationError
from dopt.models import MLP
from dopt.policies import POLICIES
from dopt.reference.batch import Lockstep, run_trials
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.trials import SMALL_SEARCHES
from tests.paths import EXAMPLE

HERE = "tests.dopt.custom_networks"


def specification(
    target: str = "Stack", seed: int = 0, policy: str = "d_optimal", **arguments: Any
) -> TrialSpec:
    return TrialSpec.from_mapping(
        {
            "env": {"name": "cartpole", "horizon": 20, "grid_points": [3, 4, 3]},
            "policy": {"name": policy},
            "model": {"_target_": target if "." in target else f"{HERE}.{target}", **arguments},
            "learner": {"name": "adam_window"},
            "seed": seed,
        }
    )


@pytest.mark.parametrize("env", SYSTEMS)
def test_a_network_predicts_what_the_shipped_one_does(env: str) -> None:
    model, system = specification(width=5, depth=3).model, SYSTEMS[env]()
    shipped, rng = MLP(width=5, depth=3), np.random.default_rng(0)
    theta = rng.normal(size=shipped.n_parameters(system))
    states = rng.normal(size=(7, system.n_states))
    assert model.n_parameters(system) == len(theta)
    predicted, expected = (one.predict(system, theta, states) for one in (model, shipped))
    np.testing.assert_allclose(predicted, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random"])
@torch.no_grad()
def test_a_trial_with_it_is_that_of_the_shipped_network(policy: str) -> None:
    spec = specification(policy=policy)
    shipped = TrialSpec.from_mapping(spec.to_mapping() | {"model": {"name": "mlp"}})
    batch, own = Lockstep([shipped]), run_trial(spec)
    batch.theta.copy_(Lockstep([spec]).theta)
    for t in range(spec.system.horizon):
        batch.step(t)
    np.testing.assert_allclose(own.states, batch.states[0].numpy(), rtol=1e-9)
    np.testing.assert_allclose(own.loss, batch.columns["loss"][0], rtol=1e-9)
    assert own.loss[-1] < own.loss[0]


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_runs_with_it_or_says_why_not(policy: str) -> None:
    mapping = specification(policy="random", width=4).to_mapping()
    mapping["env"] = {"name": "pendulum", "horizon": 6, "grid_points": [4, 4]}
    given = {"name": policy, **SMALL_SEARCHES.get(policy, {})}
    try:
        spec = TrialSpec.from_mapping(mapping | {"policy": given})
    except IncompatibleError as error:
        assert str(error).startswith(f"policy '{policy}' ")  # noqa: PT017  # the rest runs
        return
    result = run_trial(spec)
    assert np.isfinite(result.loss).all()


def test_the_seed_alone_gives_the_initial_parameters() -> None:
    torch.manual_seed(1)
    first = Lockstep([specification(policy="random")]).theta
    torch.manual_seed(2)
    expected = torch.rand(1)
    torch.manual_seed(2)
    second = Lockstep([specification(policy="d_optimal")]).theta
    assert torch.equal(torch.rand(1), expected), "torch's own generator was touched"
    assert torch.equal(first, second)
    assert not torch.equal(first, Lockstep([specification(seed=1)]).theta)


def test_a_batch_holds_networks_with_initial_parameters_of_their_own() -> None:
    specs = [specification(seed=seed) for seed in range(2)]
    for together, spec in zip(run_trials(specs), specs, strict=True):
        np.testing.assert_allclose(together.states, run_trial(spec).states, rtol=1e-9)


def test_the_trial_comes_back_from_its_mapping_and_from_another_process() -> None:
    spec = specification(width=7)
    again = TrialSpec.from_mapping(spec.to_mapping())
    sent = pickle.loads(pickle.dumps(spec))
    assert again.trial_key == spec.trial_key == sent.trial_key
    assert spec.config.path == "reference"
    assert spec.columns()["model"] == "Stack"
    assert spec.trial_key != specification(width=8).trial_key


def test_another_state_of_its_file_is_another_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    before = specification("networks.Residual")
    text = (EXAMPLE / "networks.py").read_text()
    (tmp_path / "networks.py").write_text(text + "\n# changed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("networks")
    after = specification("networks.Residual")
    sys.modules.pop("networks")
    assert after.trial_key != before.trial_key
    with pytest.raises(SpecificationError, match="another state of its file"):
        TrialSpec.from_mapping(before.to_mapping())
    assert "networks" not in sys.modules, "the other file has not run"


def test_a_replay_leads_through_the_same_states() -> None:
    spec = specification()
    seen, whole = rerun(spec, [0, 5, 20]), run_trial(spec)
    np.testing.assert_array_equal(seen.states, whole.states)
    np.testing.assert_array_equal(seen.parameters[-1], whole.parameters)
    assert seen.steps.tolist() == [0, 5, 20]


@pytest.mark.parametrize(
    ("target", "arguments", "sentence"),
    [
        ("nowhere.Net", {}, "cannot be imported"),
        ("Stakc", {}, "cannot be imported"),
        ("itertools", {}, "a class derived from torch.nn.Module is expected"),
        ("Stack", {"widht": 3}, "unexpected keyword argument 'widht'"),
        ("Stack", {"name": "mlp"}, "is called 'Stack'"),
        ("Stack", {"width": float("nan")}, "finite numbers, texts and lists"),
        ("Wide", {}, r"maps 4 features to shape \(2,\) is expected, and it gave: \(3,\)"),
        ("Empty", {}, "has parameters is expected"),
        ("Broken", {}, "no way from 4 features"),
    ],
)
def test_a_wrong_network_is_refused_in_a_sentence(
    target: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        specification(target, **arguments)
    assert "model." in str(caught.value)
