"""Batches on a GPU give the trials that they give on the CPU.

``pytest tests/dopt/reference/test_cuda.py -rs`` runs or skips them, and says which.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dopt.reference.batch import run_trials
from dopt.spec.trial import TrialSpec
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="torch finds no CUDA device on this machine"
)

OWN = {
    "network": {"_target_": "tests.dopt.custom_networks.Stack"},
    "residual": {"_target_": "tests.dopt.reference.test_reference.Residual"},
}
CASES: dict[str, TrialSpec] = {
    **{
        f"{env}-{policy}": trial(env, policy)
        for env in ("pendulum", "cartpole", "arm", "quadrotor", "drifting_pendulum")
        for policy in ("d_optimal", "uniform", "random")
    },
    "oracle": trial("arm", "oracle"),
    "periodic": trial("arm", "periodic"),
    "newest": trial("cartpole", "d_optimal", learner={"name": "adam"}),
    "sketch": trial("arm", "d_optimal", policy={"form": "sketch", "sketch_size": 48}),
    "runge_kutta": trial("pendulum", "d_optimal", env={"integrator": "rk4"}),
    **{
        name: TrialSpec.from_mapping(
            trial("arm", "d_optimal").to_mapping() | {"model": model, "path": None}
        )
        for name, model in OWN.items()
    },
    "numpy": trial("arm", "space_filling"),
}


@pytest.mark.parametrize("name", CASES)
def test_every_choice_runs_on_a_gpu(name: str) -> None:
    """Run two trials on the GPU and on the CPU, and compare what was applied, seen and learned."""
    spec = CASES[name]
    specs = [spec, spec.with_seed(spec.seed + 1)]
    for gpu, cpu in zip(run_trials(specs, "cuda"), run_trials(specs), strict=True):
        for part in ("inputs", "states", "loss", "parameters"):
            assert relative_gap(getattr(gpu, part), getattr(cpu, part)) < 1e-7, part
        assert np.isfinite(gpu.plan_us).all()
