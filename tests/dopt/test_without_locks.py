"""Logs, fits and explorations where Python has no ``fcntl``, as on a laboratory's Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
for name in ("fcntl", "pwd", "resource", "grp", "termios"):
    sys.modules[name] = None
import numpy as np
import dopt
plant = dopt.Plant(
    states={"angle": "rad", "rate": "rad/s"}, inputs={"voltage": "V"}, dt=0.02, gamma=3.0,
    known={"angle": "rate", "rate": "gain * voltage"}, constants={"gain": dopt.unknown(5.0)},
    learned=["rate"], angles=["angle"], box={"rate": 5.0}, measured={"angle": 0.001},
)
t, u = np.arange(300) * 0.02, np.sign(np.sin(np.arange(300)))
rate = np.concatenate([[0.0], np.cumsum(0.02 * 6.0 * u)[:-1]])
angle = np.concatenate([[0.0], np.cumsum(0.02 * (rate[:-1] + 0.5 * 0.02 * 6.0 * u[:-1]))])
log = dopt.Log.for_plant({"time": t, "angle": angle, "voltage": u}, plant)
found = dopt.fit(plant, log, width=0, workers=1)
assert abs(found.constants["gain"][0] - 6.0) < 0.02, found.constants
with dopt.Explorer(plant, policy="random", learner="joint_ekf", steps=20, journal="run.jsonl") as e:
    for k in range(5):
        e.ask([float(angle[k])])
        e.tell([float(angle[k + 1])])
    assert e.n_steps == 5
print("done")
"""


def test_log_fit_and_explorer_run(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.stdout.strip() == "done", run.stderr
