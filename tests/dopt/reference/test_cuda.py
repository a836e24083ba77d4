"""The torch reference on a GPU gives the trials that it gives on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from dopt.reference import recorded
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.recorded import Recorded
from dopt.spec.trial import TrialSpec
from tests.dopt.every_choice import CASES
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import KNOWN_EFFECT, trial

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="no CUDA device on this machine"
)


@pytest.fixture(autouse=True)
def captured_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeat captured graphs within the short trials of the tests."""
    monkeypatch.setattr(recorded, "FIRST_CALLS", 2)


SENSORS = {"measured_states": [0], "measurement_noise": [0.01]}
OWN = {"_target_": "tests.dopt.custom_plugins.Copy"}
SETTINGS: dict[str, TrialSpec] = {
    "runge_kutta": trial("pendulum", "d_optimal", env={"integrator": "rk4"}),
    "fresh": trial("pendulum", "d_optimal", policy={"information": "fresh", "refresh_every": 3}),
    "sensors": trial("pendulum", "d_optimal", env=SENSORS),
    "unknown_gain": trial("pendulum_unknown_gain", "d_optimal"),
    "own_policy": TrialSpec.from_mapping(
        trial("pendulum", "random").to_mapping() | {"policy": OWN}
    ),
}
"""Settings that lead to code of their own."""


def check_alike(spec: TrialSpec, module: nn.Module | None = None, bound: float = 1e-7) -> None:
    """Run two trials on the GPU and on the CPU, and compare what was applied, seen and learned."""
    specs = [spec, spec.with_seed(spec.seed + 1)]
    on_gpu = run_trials(specs, "cuda", module)
    for gpu, cpu in zip(on_gpu, run_trials(specs, module=module), strict=True):
        for part in ("inputs", "states", "loss", "parameters"):
            assert relative_gap(getattr(gpu, part), getattr(cpu, part)) < bound, part
        assert np.isfinite(gpu.plan_us).all()


@pytest.mark.parametrize("name", CASES)
def test_every_choice_runs_on_a_gpu(name: str) -> None:
    # This ascent ends on a flat top: its inputs are known to the root of the rounding.
    check_alike(CASES[name], bound=1e-6 if CASES[name].policy.name == "gradient" else 1e-7)


@pytest.mark.parametrize("env", KNOWN_EFFECT)
def test_every_system_runs_on_a_gpu(env: str) -> None:
    check_alike(trial(env, "d_optimal", env={"horizon": 8}))


@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_runs_on_a_gpu(name: str) -> None:
    check_alike(SETTINGS[name])


@pytest.mark.parametrize("policy", ["d_optimal", "random", "icem"])
def test_limits_are_heeded_on_a_gpu(policy: str) -> None:
    limits: dict[str, Any] = {"bounds": {"y": [-0.3, 0.3], "u": [-5.0, 6.0]}, "rates": {"u": 150.0}}
    mapping = trial("cartpole", policy).to_mapping()
    check_alike(TrialSpec.from_mapping(mapping | {"limits": limits}))


def test_a_module_on_the_cpu_is_explored_on_a_gpu() -> None:
    torch.manual_seed(0)
    spec = trial("arm", "d_optimal", env={"horizon": 20})
    n_in, n_out = len(spec.system.features), spec.system.n_learned
    layers = nn.Linear(n_in, 8), nn.LayerNorm(8), nn.GELU(), nn.Linear(8, n_out)
    check_alike(spec, nn.Sequential(*layers).double())


def check_captured(function: Recorded) -> None:
    assert function._recording is not None
    assert function._recording.can_be_repeated
    assert function._recording._graph is not None


@torch.no_grad()
@pytest.mark.parametrize("part", ["_columns", "_best", "_rows", "_errors", "_true_next_states"])
def test_a_graph_launches_what_a_step_calls(part: str) -> None:
    learner = {"name": "adam"}
    specs = [trial("cartpole", "d_optimal", seed, learner=learner) for seed in range(3)]
    batch = Lockstep(specs, "cuda")
    for t in range(8):
        batch.step(t)
    check_captured(getattr(batch, part))
    check_captured(batch.learner._gradient)  # type: ignore[union-attr]
    check_captured(batch.information._solve_with_rows)  # type: ignore[union-attr]


@torch.no_grad()
def test_what_waits_for_the_gpu_is_called_as_it_is() -> None:
    function = Recorded(lambda x: x + float(x.sum()))
    for size in range(1, 9):
        x = torch.full((3,), float(size), device="cuda")
        assert function(x).tolist() == [4.0 * size] * 3


@torch.no_grad()
def test_what_visits_the_cpu_is_repeated_without_a_graph() -> None:
    function = Recorded(lambda x: 2.0 * x.cpu().cuda())
    for size in range(1, 9):
        x = torch.full((3,), float(size), device="cuda")
        assert function(x).tolist() == [2.0 * size] * 3
