"""``export mlflow`` and ``export wandb``: read back by the libraries that others use."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from orchestrate.store import Store
from tests.orchestrate.commands.conftest import BAD, DONE, SECRET, Answer, run_now
from tests.orchestrate.commands.wandb_file import OfflineRun, read_run
from tests.orchestrate.store.fakes import Spec, assessed, diverged, result

Run = Callable[..., Answer]
MEASURED = Spec(9, env="cartpole")
RESULTS = {
    **{spec: result(spec.seed) for spec in DONE},
    BAD: diverged(3, seed=BAD.seed),
    MEASURED: assessed(9),
}


@pytest.fixture
def runs(grid: int, store: Store) -> None:
    """Add a trial with assessments to the grid."""
    (claim,) = store.claim(grid, store.register(grid, [MEASURED]).todo)
    store.commit(claim, RESULTS[MEASURED], run_now())


@pytest.fixture(autouse=True)
def _warnings_of_libraries() -> Iterator[None]:
    """Let the libraries warn of what they use of others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def export(command: Run, kind: str, out: Path) -> None:
    answer = command("export", kind, str(out))
    assert (answer.code, answer.err) == (0, "")
    assert f"{out}: {len(RESULTS)} trials, " in answer.out


@pytest.mark.usefixtures("runs")
class TestMlflow:
    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("mlflow", reason="needs the extra mlflow")

    def test_the_client_reads_every_run(self, command: Run, tmp_path: Path) -> None:
        from mlflow import MlflowClient

        export(command, "mlflow", tmp_path / "out")
        client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'out' / 'mlflow.db'}")
        names = {one.name: one.experiment_id for one in client.search_experiments()}
        assert {"pendulum", "cartpole"} <= set(names)
        found = {
            run.data.tags["trial_key"]: run
            for run in client.search_runs([names["pendulum"], names["cartpole"]])
        }
        assert set(found) == {spec.trial_key for spec in RESULTS}
        for spec, expected in RESULTS.items():
            run = found[spec.trial_key]
            assert run.data.params["env"] == spec.env
            assert run.data.params["width"] == "16"
            assert run.data.params["seed"] == str(spec.seed)
            assert run.data.tags["mlflow.source.git.commit"] == "0" * 40
            assert run.data.tags["git_dirty"] == "True"
            assert run.info.status == "FINISHED"
            year = datetime.fromtimestamp(run.info.start_time / 1000, UTC).year
            assert year == datetime.now(UTC).year
            for name in ("loss", "reachable_loss"):
                history = client.get_metric_history(run.info.run_id, name)
                values = getattr(expected, name)[: expected.n_steps]
                assert [one.step for one in history] == list(range(len(values)))
                np.testing.assert_array_equal([one.value for one in history], values)
        assert found[BAD.trial_key].data.tags["status"] == "diverged"
        assert "final_loss" not in found[BAD.trial_key].data.metrics
        done = found[DONE[0].trial_key].data.metrics
        assert done["final_loss"] == RESULTS[DONE[0]].final_loss
        history = client.get_metric_history(found[MEASURED.trial_key].info.run_id, "cost")
        costs = [row for row in RESULTS[MEASURED].assessments if row.measure == "cost"]
        assert [(one.step, one.value) for one in history] == [(c.t, c.value) for c in costs]

    def test_it_is_replaced_by_another_and_names_its_origin(
        self, command: Run, tmp_path: Path
    ) -> None:
        out = tmp_path / "out"
        for _ in range(2):
            export(command, "mlflow", out)
        facts = json.loads((out / "provenance.json").read_text())
        assert facts["kind"] == "mlflow"
        assert facts["library"].startswith("mlflow-skinny ")
        assert {path.name for path in out.iterdir()} == {"mlflow.db", "provenance.json"}
        assert all(SECRET.encode() not in path.read_bytes() for path in out.iterdir())


@pytest.mark.usefixtures("runs")
class TestWandb:
    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("wandb", reason="needs the extra wandb")

    def test_every_run_is_read_back(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "out"
        export(command, "wandb", out)
        found: dict[str, OfflineRun] = {}
        for path in out.glob("wandb/offline-run-*/run-*.wandb"):
            run = read_run(path)
            found[run.config["trial"]["trial_key"]] = run
        assert set(found) == {spec.trial_key for spec in RESULTS}
        for spec, expected in RESULTS.items():
            run = found[spec.trial_key]
            assert (run.project, run.is_finished) == ("dopt", True)
            assert run.name == f"{spec.env}, {spec.policy}, seed {spec.seed}"
            assert (run.config["seed"], run.config["width"]) == (spec.seed, 16)
            assert run.config["trial"]["git_commit"] == "0" * 40
            assert [row["_step"] for row in run.history] == list(range(expected.n_steps))
            for name in ("loss", "reachable_loss"):
                values = getattr(expected, name)[: expected.n_steps]
                np.testing.assert_array_equal([row[name] for row in run.history], values)
            assert run.summary.get("final_loss") == expected.final_loss
            for row in expected.assessments:
                if np.isfinite(row.value):
                    assert run.summary[f"{row.measure}/{row.t}"] == row.value
        self.check_sync(out)
        assert all(
            SECRET.encode() not in path.read_bytes() for path in out.rglob("*") if path.is_file()
        )

    def check_sync(self, folder: Path) -> None:
        """Check that the library's own command finds every run; old versions cannot tell."""

        def sync(option: str) -> str:
            done = subprocess.run(
                [sys.executable, "-m", "wandb", "sync", option],
                cwd=folder,
                capture_output=True,
                text=True,
                check=True,
            )
            return done.stdout + done.stderr

        if "--dry-run" in sync("--help"):
            assert f"Would sync {len(RESULTS)} run(s)" in sync("--dry-run")


@pytest.mark.parametrize(
    ("kind", "module", "package"),
    [("mlflow", "mlflow", "mlflow-skinny"), ("wandb", "wandb", "wandb")],
)
@pytest.mark.usefixtures("grid")
def test_a_library_that_is_not_installed_is_named(
    kind: str,
    module: str,
    package: str,
    command: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    answer = command("export", kind, str(tmp_path / "out"))
    assert answer.code == 2
    assert answer.err == (
        f"error: The export {kind} needs the package {package}, which is not installed: "
        f"run pip install 'dopt-exploration[{kind}]'.\n"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("grid")
@pytest.mark.parametrize("kind", ["mlflow", "wandb"])
def test_nothing_done_is_nothing_to_export(kind: str, command: Run, tmp_path: Path) -> None:
    answer = command("export", kind, str(tmp_path / "out"), "--env", "cartpole")
    assert answer.code == 2
    assert "is done yet, so that there are no runs to export" in answer.err
