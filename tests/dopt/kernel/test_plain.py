"""``DOPT_PLAIN=1``: the kernel's own text in the interpreter gives the trials of compiled code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial
from tests.paths import ROOT

NETWORK = {"name": "mlp", "width": 3, "depth": 1}
STAR = {"name": "grey_box", "unknown": ["center_x", "center_y"], "initial": [0.1, 0.1]}
ENCODERS = {"measured_states": [0, 2], "measurement_noise": [0.01, 0.01], "horizon": 6}
TRIALS = [
    trial("pendulum", "d_optimal", 1, env={"horizon": 6}, model=NETWORK),
    trial("moving_star", "lookahead", 1, env={"horizon": 12}, model=STAR),
    trial("arm", "random", 1, env=ENCODERS, model=NETWORK, learner={"name": "joint_ekf"}),
]
PROGRAM = """
import json, sys
from numba.core.dispatcher import Dispatcher
from dopt.kernel import loop
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
assert not isinstance(loop.advance, Dispatcher)
found = []
for mapping in json.load(sys.stdin):
    result = run_trial(TrialSpec.from_mapping(mapping))
    found.append({name: getattr(result, name).tolist() for name in sys.argv[1:]})
print(json.dumps(found))
"""
EXACT, SINGLE = ("states", "inputs", "parameters"), ("loss", "reachable_loss")
"""What is computed in double precision, and losses, which may be judged in single precision."""


@pytest.fixture(scope="module")
def plain() -> list[dict[str, Any]]:
    given = json.dumps([spec.to_mapping() for spec in TRIALS])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *EXACT, *SINGLE],
        input=given,
        env=os.environ | {"DOPT_PLAIN": "1"},
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("index", range(len(TRIALS)))
def test_both_give_the_same_trial(index: int, plain: list[dict[str, Any]]) -> None:
    spec: TrialSpec = TRIALS[index]
    compiled, found = run_trial(spec), plain[index]
    for name in EXACT:
        values = getattr(compiled, name)
        scale = np.abs(values).max()
        assert np.array(found[name]) == pytest.approx(values, rel=0.0, abs=1e-12 * scale), name
    for name in SINGLE:
        assert np.array(found[name]) == pytest.approx(getattr(compiled, name), rel=1e-5), name
