"""Sample losses: what a policy collected, beside what its learner made of it."""

from __future__ import annotations

import io
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from starlette.testclient import TestClient

from analysis.cli import main
from analysis.data.samples import load
from analysis.serve.app import create_app
from analysis.tables import rendering
from dopt.offline_fit import sample_loss
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial

SPECS = [trial("pendulum", policy, seed) for policy in ("d_optimal", "random") for seed in range(3)]
READING = [trial("pendulum", "uniform", seed, model={"name": "black_box"}) for seed in range(3)]


def expected(policy: str) -> np.ndarray:
    """Return final and sample losses of trials that are run here, (n, 2)."""
    specs = [spec for spec in SPECS if spec.policy.name == policy]
    results = [run_trial(spec) for spec in specs]
    return np.array(
        [
            (one.loss[-1], sample_loss(spec, one.states, one.inputs))
            for spec, one in zip(specs, results, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database with trials that have no sample loss; one of them diverged."""
    file = tmp_path_factory.mktemp("samples") / "results.db"
    lost = trial("pendulum", "random", 3)
    real = {spec.trial_key for spec in SPECS}
    fill(
        f"sqlite:///{file}",
        [*SPECS, *READING, lost],
        diverged={lost.trial_key: 9},
        edit=lambda spec, one: simulated(spec, one) if spec.trial_key in real else one,
    )
    return file


@pytest.fixture
def url(made: Path, tmp_path: Path) -> str:
    """Return a copy of the database."""
    return f"sqlite:///{shutil.copy(made, tmp_path / 'copy.db')}"


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[str, str]:
    assert main([*words, "--allow-partial"]) == 0
    found = capsys.readouterr()
    return found.out, found.err


def test_rows_are_geometric_means_over_the_trials(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output, notes = run(capsys, "sample-loss", "--db", url, "--format", "csv")
    table = pd.read_csv(io.StringIO(output)).set_index("policy")
    assert set(table.index) == {"d_optimal", "random"}
    for policy, row in table.iterrows():
        logs = np.log(expected(str(policy)))
        for name, own in (
            ("loss", logs[:, 0]),
            ("sample_loss", logs[:, 1]),
            ("ratio", logs[:, 0] - logs[:, 1]),
        ):
            low, high = stats.t.interval(0.95, 2, np.mean(own), stats.sem(own))
            shown = row[[name, f"{name}_low", f"{name}_high"]].to_numpy(float)
            np.testing.assert_allclose(np.log(shown), [np.mean(own), low, high], atol=1e-6)
        assert row.n == 3
    assert "pendulum, random, trials left out: 1, diverged" in notes
    assert "trials left out: 3, assess.sample_loss goes with a model of the states alone" in notes


def test_trials_without_stored_states_are_named(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(url.removeprefix("sqlite:///")) as database:
        database.execute("DELETE FROM trajectory WHERE trial_id <= 2")
    output, notes = run(capsys, "sample-loss", "--db", url, "--env", "pendulum")
    assert "trials left out: 2, their states and inputs are not stored" in notes
    assert "D-optimal" in output


def test_what_is_stored_is_in_tables_report_and_browser_and_is_not_fitted_again(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = ("summary", "--db", url, "--format", "csv")
    assert "sample_loss" not in run(capsys, *summary)[0]
    fitted, _ = run(capsys, "sample-loss", "--db", url, "--store")
    monkeypatch.setattr(rendering, "sample_loss", None)
    assert run(capsys, "sample-loss", "--db", url, "--store")[0] == fitted
    own = expected("random")[:, 1]
    table = pd.read_csv(io.StringIO(run(capsys, *summary)[0])).set_index("policy")
    assert table.loc["random", "sample_loss"] == pytest.approx(np.mean(own))
    assert table.loc["random", "sample_loss_2se"] == pytest.approx(2 * stats.sem(own))
    assert table["sample_loss"].isna().to_dict() == {
        "d_optimal": False,
        "random": False,
        "uniform": True,
    }
    run(capsys, "report", "--db", url, "--out", str(tmp_path / "report"))
    shown = pd.read_csv(tmp_path / "report" / "report.csv").set_index("policy")
    assert shown.loc["random", "sample_loss"] == pytest.approx(np.mean(own))
    assert "| sample loss" in (tmp_path / "report" / "README.md").read_text()
    with load(url, policy="random") as results:
        rows = "SELECT t, value FROM v_assessment WHERE policy = 'random' ORDER BY seed"
        found = results.reader.query(rows)
    assert [row.value for row in found] == pytest.approx(own)
    assert {row.t for row in found} == {30}
    with TestClient(create_app(url, "127.0.0.1"), base_url="http://127.0.0.1:8000") as client:
        rows = client.get("/api/trials?policy=random&sort=sample_loss").json()["rows"]
        cells = client.get("/api/grid").json()["environments"][0]["rows"][0]["cells"]
        grid = client.get("/").text
    assert [row["sample_loss"] for row in rows[:3]] == pytest.approx(sorted(own))
    assert rows[3]["sample_loss"] is None  # it diverged
    tiles = {one["policy"]: one for cell in cells for one in cell["configurations"]}
    assert tiles["random"]["sample_loss"] == pytest.approx(np.mean(own))
    assert grid.count("<small>samples ") == 2


def test_a_trial_that_is_assessed_while_it_runs_has_the_same(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """And is shown in place of the one without: their losses are the same."""
    mapping = SPECS[0].to_mapping() | {"assess": {"sample_loss": True}}
    specs = [TrialSpec.from_mapping(mapping | {"seed": seed}) for seed in range(3)]
    fill(url, specs, edit=simulated)
    output, notes = run(capsys, "summary", "--db", url, "--policy", "d_optimal", "--format", "csv")
    (row,) = pd.read_csv(io.StringIO(output)).to_dict("records")
    assert row["sample_loss"] == pytest.approx(np.mean(expected("d_optimal")[:, 1]))
    assert row["label"] == "D-optimal"
    assert "1 other stored configuration" in notes
