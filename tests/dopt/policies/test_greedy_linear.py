"""Linear identification: the closed form of the paper's [7], and that Proposition 1 recovers it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError
from dopt.policies.d_optimal import is_linear
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.oracles.traces import trace
from tests.dopt.trials import trial


def linear_trial(policy: str, seed: int = 0, **env: Any) -> TrialSpec:
    return trial(
        "mass_spring",
        policy,
        seed,
        env=env,
        policy={"regularization": 1e-3},
        model={"name": "linear_state"},
        learner={"name": "recursive_least_squares"},
    )


@pytest.mark.parametrize("seed", range(2))
def test_the_d_optimal_policy_recovers_the_linear_one_exactly(seed: int) -> None:
    """Section 2: "we recover the D-optimal exploration algorithm of [7]"."""
    general, closed = (
        run_trial(linear_trial(policy, seed, horizon=80)) for policy in ("d_optimal", "linear")
    )
    assert closed.inputs == pytest.approx(general.inputs, rel=0.0, abs=1e-7)
    assert closed.states == pytest.approx(general.states, rel=0.0, abs=1e-7)
    assert closed.loss == pytest.approx(general.loss, rel=1e-5)
    assert len(np.unique(closed.inputs.round(6), axis=0)) > 50


def test_no_input_on_the_circle_grows_the_determinant_more() -> None:
    spec = linear_trial("linear", 3)
    system, run = spec.system, trace(spec)
    gram = 1e-3 * np.eye(4)
    angles = np.linspace(0.0, 2 * np.pi, 721)
    circle = system.gamma * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for t in range(12):
        x, theta = run.states[t], run.parameters[t]
        gains = [_log_det(spec, theta, gram, x, u) for u in (run.inputs[t], *circle)]
        if t > 0:
            assert gains[0] >= max(gains[1:]) - 1e-9
        z = system.featurize(x[None])[0]
        gram += np.outer(z, z)


def _log_det(
    spec: TrialSpec, theta: np.ndarray, gram: np.ndarray, x: np.ndarray, u: np.ndarray
) -> float:
    """Return log det(Γ + x(u) x(u)ᵀ) with the current estimate in x(u)."""
    system = spec.system
    step = np.array(system.known(tuple(x), tuple(u), system.parameters))
    step[list(system.learned_rows)] += spec.model.predict(system, theta, x[None])[0]
    z = system.featurize((x + system.dt * step)[None])[0]
    return float(np.linalg.slogdet(gram + np.outer(z, z))[1])


def test_the_estimate_tends_to_the_true_matrix() -> None:
    spec = linear_trial("linear", 1, horizon=200)
    system = spec.system
    assert system.name == "mass_spring"
    found = run_trial(spec).parameters.reshape(2, 4) / np.array(system.feature_scales)
    k, c = system.parameters[1:]
    true = [[-2 * k, -2 * c, k, c], [k, c, -2 * k, -2 * c]]
    assert found == pytest.approx(np.array(true), abs=0.02)


def test_only_linear_systems_are_linear() -> None:
    assert [name for name, system in SYSTEMS.items() if is_linear(system())] == ["mass_spring"]
    with pytest.raises(IncompatibleError, match="policy 'linear' needs dynamics that are linear"):
        trial("arm", "linear")


def test_the_linear_policy_takes_the_linear_model() -> None:
    with pytest.raises(IncompatibleError, match="goes with model 'linear_state'"):
        trial("mass_spring", "linear", model={"name": "rff"})
