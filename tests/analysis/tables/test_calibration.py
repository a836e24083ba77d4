"""The table of fits at held-out states: against its definition, and what it refuses."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.cli import main
from dopt.calibration import held_out_fit
from dopt.run import run_trial
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial

LEARNER = {"name": "gauss_newton"}
TAUGHT = [trial("pendulum", "d_optimal", seed, learner=LEARNER) for seed in range(3)]
UNSURE = [trial("pendulum", "random", seed, learner={"name": "adam_window"}) for seed in range(3)]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('calibration')}/results.db"
    fill(address, TAUGHT + UNSURE, edit=simulated)
    return address


def test_rows_are_the_medians_of_the_trials(small: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibration", "--db", small, "--format", "csv"]) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out)).set_index("policy")
    results = [run_trial(spec) for spec in TAUGHT]
    fits = [
        held_out_fit(spec, one.parameters, one.states, one.inputs)
        for spec, one in zip(TAUGHT, results, strict=True)
    ]
    row = table.loc["d_optimal"]
    for name in ("r_squared", "covered", "log_loss"):
        for kind in ("grid", "reachable"):
            average = np.mean if name == "covered" else np.median
            expected = average([getattr(getattr(fit, kind), name) for fit in fits])
            assert row[f"{kind}_{name}"] == pytest.approx(expected, rel=1e-3)
    assert row.energy == pytest.approx(1.0)  # every input is on the sphere
    assert row.n == 3
    assert np.isnan(table.loc["random", "grid_covered"])


def test_a_model_without_a_covariance_has_a_dash(
    small: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibration", "--db", small, "--policy", "random"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "pendulum" in line]
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[4:8] == ["–"] * 4
    assert "–" not in cells[2:4] + cells[8:]


def test_a_database_without_a_finished_trial_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/none.db"
    fill(address, TAUGHT, skipped=TAUGHT)
    assert main(["calibration", "--db", address, "--allow-partial"]) == 2
    assert "No selected trial is done" in capsys.readouterr().err
