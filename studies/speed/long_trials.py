"""Time and memory of long trials, on systems of up to 40 dimensions.

``python -m studies.speed.long_trials`` runs all; with SYSTEM STEPS it runs one of them and prints
what its steps took. It is a process of its own, whose memory is the memory of the trial.
"""

from __future__ import annotations

import json
import sys

import numpy as np

from benchmarks import processes
from benchmarks.rows import Row
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from studies.speed import show

SYSTEMS: dict[str, dict[str, object]] = {
    "cartpole": {},
    # It flies tens of kilometres.
    "drone": {"state_limit": 1e6},
    # The chain of env=beyond/chain as long and as heavy as it is there, of shorter links.
    # Its fastest modes take steps of Runge and Kutta.
    "chain": {
        "n_links": 20,
        "length": 0.1,
        "mass": 0.05,
        "friction": 0.02,
        "gamma": 0.2,
        "dt": 0.01,
        "integrator": "rk4",
    },
}
WIDTH = 64
STEPS, FEW_STEPS = 100_000, 2_000


def measure(quick: bool) -> list[Row]:
    """Return what planning and learning take at the end of a trial with the sketch."""
    return [_row(name, FEW_STEPS if quick else STEPS) for name in SYSTEMS]


def _row(name: str, steps: int) -> Row:
    short = processes.run("-m", "studies.speed.long_trials", name, str(steps // 10))
    done = processes.run("-m", "studies.speed.long_trials", name, str(steps))
    took = json.loads(done.output.splitlines()[-1])
    note = (
        f"q = {took['parameters']:,}; {took['first_us']:.0f} µs in the second tenth; peak "
        f"{done.peak_mebibytes:.0f} MiB, with a tenth of the steps {short.peak_mebibytes:.0f}; the "
        f"result takes {took['result_mebibytes']:.0f}"
    )
    return Row(f"{name}, {steps:,} steps, width {WIDTH}", took["last_us"], "µs a step", note=note)


def _run(name: str, steps: int) -> None:
    """Run a long trial and print what its steps took."""
    spec = TrialSpec.from_mapping(
        {
            "env": {"name": name, "horizon": steps, **SYSTEMS[name]},
            "policy": {"name": "d_optimal", "form": "sketch"},
            "model": {"name": "mlp", "width": WIDTH},
            "learner": {"name": "adam_window"},
            "seed": 0,
        }
    )
    result = run_trial(spec)
    if result.diverged_at is not None:
        raise RuntimeError(f"the trial of {name} diverged at step {result.diverged_at}")
    spent, tenth = result.plan_us + result.learn_us, steps // 10
    took = {
        "parameters": spec.model.n_parameters(spec.system),
        "first_us": spent[tenth : 2 * tenth].mean(),
        "last_us": spent[-tenth:].mean(),
        "result_mebibytes": _bytes(result) / 2**20,
    }
    sys.stdout.write(f"{json.dumps(took)}\n")


def _bytes(result: TrialResult) -> int:
    """Return the bytes of all columns of a result."""
    return sum(value.nbytes for value in vars(result).values() if isinstance(value, np.ndarray))


if __name__ == "__main__":
    if len(sys.argv) > 2:
        _run(sys.argv[1], int(sys.argv[2]))
    else:
        show(measure("--quick" in sys.argv))
