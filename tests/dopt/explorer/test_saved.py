"""Saved explorations: they live between saves, and commands, merges, pages and frames show them."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

import analysis
import analysis.cli
import dopt
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.errors import AnalysisError
from analysis.serve.app import create_app
from analysis.tables.comparisons import compare_policies
from dopt import Explorer, TrialSpec
from orchestrate.__main__ import main
from orchestrate.commands.maintenance import trial_key
from orchestrate.store import Reader, Store, StoreUnavailableError, explorations
from orchestrate.store.doctor import examine
from orchestrate.store.merge import merge
from tests.dopt.explorer.saves import content, drive, explorer
from tests.orchestrate.store.fakes import LAUNCH, RUN
from tests.orchestrate.store.test_leases import wait_for_renewals


def test_it_runs_until_it_is_closed(url: str, run: Explorer) -> None:
    def state() -> str:
        with Reader.open(url) as reader:
            [found] = explorations(reader)
            return found.state

    run.save(url)
    assert state() == "running, 40 of 300 steps"
    run.close()
    assert state() == "done, 40 of 300 steps"


def test_an_exploration_lives_between_two_saves(
    postgresql_url: str, run: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launch whose lease has run out is taken for lost, and its session ended in a save."""
    monkeypatch.setattr("orchestrate.runner.saving.HEARTBEATS_PER_LEASE", 600)
    assert run.save(postgresql_url)
    wait_for_renewals(postgresql_url)
    with Store.open(postgresql_url) as others, Reader.open(postgresql_url) as reader:
        assert others.recover() == 0
        [launch] = reader.launches()
        assert launch.state == "running"
        drive(run, 2)
        assert run.save(postgresql_url)
        run.close()
        [launch] = reader.launches()
        assert launch.state == "done"
    assert "heartbeat" not in [thread.name for thread in threading.enumerate()]


def test_commands_show_it(
    sqlite_url: str, run: Explorer, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run.save(sqlite_url)

    def said(*words: str) -> str:
        assert main([*words, "--db", sqlite_url]) == 0
        return capsys.readouterr().out

    line = "plant, random, prequential loss, seed 0: running, 40 of 300 steps"
    assert line in said("status")
    assert "running, 40 of 300 steps" in said("show")
    assert "prequential loss, log scale, 40 steps" in said("show")
    assert "40" in said("query", "SELECT count(*) AS n FROM v_curve WHERE env = 'plant'")
    for kind in ("curves", "trajectories", "trials"):
        for form in ("csv", "npz", "parquet"):
            said("export", kind, "--format", form, "--out", str(tmp_path / f"{kind}.{form}"))
    with np.load(tmp_path / "curves.npz") as arrays:
        assert np.array_equal(arrays["plant/random/16/loss"], [run.errors])
    assert "Nothing is wrong" in said("doctor")


def test_a_merge_takes_it_and_what_it_has_grown_by(url: str, tmp_path: Path, run: Explorer) -> None:
    target = f"sqlite:///{tmp_path}/target.db"
    run.save(url)
    assert merge(target, url).added == {"done": 1}
    assert content(target) == content(url)
    assert merge(target, url).identical == 1
    drive(run, 25)
    run.save(url)
    assert merge(url, target).kept == 1, "there are fewer steps"
    assert merge(target, url).added == {"done": 1}
    assert content(target) == content(url)
    assert not examine(target, trial_key)


def test_a_merge_keeps_another_run_of_the_same_arguments_apart(
    url: str, tmp_path: Path, run: Explorer
) -> None:
    run.save(url)
    with explorer() as other:
        other.ask([0.3, 0.0])
        other.tell([0.3, 0.1])
        other.save(f"sqlite:///{tmp_path}/other.db")
    assert len(merge(url, f"sqlite:///{tmp_path}/other.db").conflicts) == 1


@pytest.fixture
def client(url: str) -> Iterator[TestClient]:
    app = create_app(url)
    with TestClient(app, base_url="http://127.0.0.1:8000") as opened:
        yield opened


def test_the_pages_show_it_live(url: str, client: TestClient, run: Explorer) -> None:
    run.save(url, test=(run.states, run.inputs) if run.n_steps > 50 else None)
    key = content(url)["trial_key"]
    for page in ("/", "/trials", f"/trials/{key}", "/curves", "/sql"):
        assert client.get(page).status_code == 200, page
    assert "prequential loss" in client.get("/").text
    assert "running, 40 of 300 steps" in client.get(f"/trials/{key}").text
    arrays = client.get(f"/api/trials/{key}/arrays").json()
    assert arrays["loss"] == run.errors.tolist()
    assert arrays["is_prequential"] is True
    assert arrays["phase"]["labels"] == ["angle [rad]", "rate [rad/s]"]
    token = client.get("/api/grid").json()["progress"]["token"]
    assert len(client.get("/api/curves?env=plant").json()["x"]) == 40
    drive(run, 10)
    run.save(url)
    assert client.get("/api/grid").json()["progress"]["token"] != token
    assert len(client.get("/api/curves?env=plant").json()["x"]) == 50
    run.close()
    assert "done, 50 of 300 steps" in client.get(f"/trials/{key}").text


def test_a_frame_of_runs_of_unequal_length(sqlite_url: str, run: Explorer) -> None:
    run.save(sqlite_url)
    with explorer(seed=1) as other:
        drive(other, 70)
        other.save(sqlite_url)
        ends = other.errors[40:]
    with analysis.load(sqlite_url) as results:
        matrix = results.matrix("plant", "random")
        paths = results.trajectories("plant", "random")
        model = results.model(results.trials().iloc[0])
    assert matrix.values.shape == (2, 70)
    assert np.isnan(matrix.values[0, 40:]).all()
    assert np.array_equal(matrix.values[1, 40:], ends)
    assert paths.states.shape == (2, 71, 2)
    assert paths.inputs.shape == (2, 70, 1)
    states = run.states[:5]
    assert np.array_equal(model.predict(states), run.predict(states))


def test_it_is_not_compared_with_simulated_trials(sqlite_url: str) -> None:
    system = dopt.SYSTEMS["pendulum"](horizon=20)
    for policy in ("d_optimal", "random"):
        with Explorer(system, policy=policy) as one:
            x = np.zeros(2)
            for _ in range(20):
                one.ask(x)
                x = x + 0.01
                one.tell(x)
            one.save(sqlite_url)
    with Reader.open(sqlite_url) as reader:
        selection = select(reader, Filter())
        assert selection.labels == ("D-optimal, prequential loss", "random, prequential loss")
        assert not selection.gaps
        with pytest.raises(AnalysisError, match="but no simulated trial is selected"):
            compare_policies(reader, selection)


def test_simulated_trials_go_before_it(sqlite_url: str) -> None:
    system = dopt.SYSTEMS["pendulum"](horizon=20)
    spec = TrialSpec.of_system(system, "d_optimal")
    trial = dopt.run_trial(spec)
    with Store.open(sqlite_url) as store:
        launch = store.begin_launch(LAUNCH)
        [claim] = store.claim(launch, store.register(launch, [spec]).todo)
        assert store.commit(claim, trial, RUN)
    with Explorer(system) as one:
        for x, x_next in zip(trial.states, trial.states[1:], strict=False):
            one.ask(x)
            one.tell(x_next)
        one.save(sqlite_url)
    with Reader.open(sqlite_url) as reader:
        selection = select(reader, Filter())
        [entry] = selection.entries
    assert entry.config.config_key == spec.config_key
    assert selection.notes == (
        "pendulum: 1 other stored configurations are not part of this (see --where)",
    )
    assert not examine(sqlite_url, trial_key)


def test_the_caption_of_its_curve_names_no_grid(
    sqlite_url: str, run: Explorer, tmp_path: Path
) -> None:
    run.save(sqlite_url)
    folder = tmp_path / "figures"
    drawn = ["figures", "--db", sqlite_url, "--out", str(folder), "--only", "figure1"]
    assert analysis.cli.main(drawn) == 0
    words = (folder / "figure1.txt").read_text()
    assert words.startswith("Error of each prediction of a measured exploration before it was")
    assert "grid" not in words


@pytest.mark.parametrize("renamed", [False, True])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_database_that_is_gone_is_said_and_written_anew(
    renamed: bool, replaced: bool, sqlite_url: str, tmp_path: Path, run: Explorer
) -> None:
    path, moved = Path(sqlite_url.removeprefix("sqlite:///")), tmp_path / "moved.db"
    run.save(sqlite_url)
    before = content(sqlite_url)
    path.rename(moved)
    if not renamed:
        moved.unlink()
    if replaced:
        path.touch()
    drive(run, 5)
    said = "replaced by another file" if replaced else "removed or renamed"
    with pytest.raises(StoreUnavailableError, match=rf"{said} since .*Explorer that saves again"):
        run.save(sqlite_url)
    if renamed:
        assert content(f"sqlite:///{moved}") == before
    drive(run, 5)
    assert run.save(sqlite_url)
    assert content(sqlite_url)["n_steps"] == 50
    assert not examine(sqlite_url, trial_key)
    run.close()


@pytest.mark.parametrize("table", ["trial", "launch"])
def test_rows_that_were_deleted_by_hand_are_said(
    table: str, sqlite_url: str, run: Explorer
) -> None:
    run.save(sqlite_url)
    with sqlite3.connect(sqlite_url.removeprefix("sqlite:///")) as connection:
        connection.execute(f"DELETE FROM {table}")
    connection.close()
    drive(run, 5)
    with pytest.raises(StoreUnavailableError, match=r"its tables contradict each other.*restore"):
        run.save(sqlite_url)
    run.close()
