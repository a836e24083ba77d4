"""Explorations saved in a database: saves, commands, merges, pages and frames."""

from __future__ import annotations

import itertools
import shutil
import sqlite3
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

import analysis
import analysis.cli
import dopt
from analysis.data.matching import AnalysisError, Filter
from analysis.data.selection import select
from analysis.serve.app import create_app
from analysis.tables.comparisons import compare_policies
from dopt import Explorer, TrialSpec
from dopt.errors import DoptError, SpecificationError
from dopt.policies.base import OpenLoop
from dopt.systems import System
from dopt.types import Array
from orchestrate.__main__ import main
from orchestrate.store import Reader, Store, StoreError, StoreUnavailableError
from orchestrate.store import store as writing
from orchestrate.store.maintenance import examine
from orchestrate.store.merge import merge
from tests.dopt.explorer.plants import STEPS, content, drive, explorer
from tests.orchestrate.store.fakes import LAUNCH, RUN, begin
from tests.orchestrate.store.test_leases import wait_for_renewals


def test_what_ask_and_tell_took_is_stored(url: str, run: Explorer) -> None:
    """Each is shorter than the whole exploration, and longer than a clock's step."""
    begun = time.perf_counter()
    drive(run, 10)
    whole = 1e6 * (time.perf_counter() - begun)
    run.save(url)
    with Reader.open(url) as reader:
        rows = reader.rows("SELECT plan_us, learn_us FROM step ORDER BY t")
        times = np.array([tuple(row) for row in rows], dtype=float)[-10:]
    assert (times > 0.1).all()
    assert times.sum() < whole
    t, x = run.n_steps, run.states[-1]
    run.ask(x)
    planned = run._times[0, t]
    run.ask(x)  # the same answer, which takes less
    assert run._times[0, t] >= planned


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
    assert "40" in said("query", "SELECT count(*) AS n FROM v_curve WHERE env = 'plant'")
    for kind in ("curves", "trajectories", "trials"):
        for form in ("csv", "parquet"):
            said("export", kind, "--format", form, "--out", str(tmp_path / f"{kind}.{form}"))
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
    assert not examine(target)


def test_another_run_of_these_arguments_stays_apart(
    url: str, tmp_path: Path, run: Explorer
) -> None:
    run.save(url)
    before = content(url)
    with explorer() as other:
        other.ask([0.3, 0.0])
        other.tell([0.3, 0.1])
        with pytest.raises(StoreError, match=r"holds another exploration .* \(40 steps\).*seed"):
            other.save(url)
        other.save(f"sqlite:///{tmp_path}/other.db")
    with Reader.open(url) as reader:
        assert len(reader.launches()) == 1
    assert len(merge(url, f"sqlite:///{tmp_path}/other.db").conflicts) == 1
    assert content(url) == before


def test_the_pages_show_it_live(url: str, run: Explorer) -> None:
    run.save(url)
    key = content(url)["trial_key"]
    with TestClient(create_app(url), base_url="http://127.0.0.1:8000") as client:
        for page in ("/", "/trials", f"/trials/{key}", "/curves"):
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


def drive_through(one: Explorer, states: Array) -> None:
    """Let an explorer meet given states."""
    for x, following in itertools.pairwise(states):
        one.ask(x)
        one.tell(following)


def test_it_is_not_compared_with_simulated_trials(sqlite_url: str) -> None:
    system = dopt.SYSTEMS["pendulum"](horizon=20)
    for policy in ("d_optimal", "random"):
        with Explorer(system, policy=policy) as one:
            drive_through(one, np.linspace([0.0, 0.0], [0.2, 0.2], 21))
            one.save(sqlite_url)
    with Reader.open(sqlite_url) as reader:
        selection = select(reader, Filter())
        assert selection.labels == ("D-optimal, prequential loss", "random, prequential loss")
        assert not selection.gaps
        with pytest.raises(AnalysisError, match=r"the selection \(no simulated trial\) has none"):
            compare_policies(reader, selection)


def test_the_caption_of_a_curve_names_no_grid(
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
    assert not examine(sqlite_url)
    run.close()


@pytest.mark.parametrize("table", ["trial", "launch"])
def test_rows_deleted_by_hand_are_said(table: str, sqlite_url: str, run: Explorer) -> None:
    run.save(sqlite_url)
    with sqlite3.connect(sqlite_url.removeprefix("sqlite:///")) as connection:
        connection.execute(f"DELETE FROM {table}")
    connection.close()
    drive(run, 5)
    with pytest.raises(StoreUnavailableError, match=r"its tables contradict each other.*restore"):
        run.save(sqlite_url)
    run.close()


def test_stored_is_what_was_explored(
    url: str, run: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a URL it is the database of the launches; and nothing is before the first step."""
    monkeypatch.setenv("DOPT_DB", url)
    with explorer() as one:
        assert not one.save(url)
    assert run.save()
    with Reader.open(url) as reader:
        [config] = reader.configs()
        curves = reader.curves(config.config_key)
        stored = reader.trajectory(config.config_key, 0)
        [trial] = reader.trials(config.config_key)
    assert np.array_equal(curves.values, [run.errors])
    assert curves.t.tolist() == list(range(40))
    for name in ("states", "inputs", "parameters"):
        assert np.array_equal(getattr(stored, name), getattr(run, name))
    assert (trial.status, trial.n_steps, trial.final_loss) == ("done", 40, run.errors[-1])
    assert (config.env, config.horizon) == ("plant", STEPS)
    assert config.label == "random, prequential loss"
    assert config.config["env"]["loss"] == "prequential"


def test_an_exploration_by_a_policy_of_a_script_is_saved(sqlite_url: str) -> None:
    """Nobody runs again what was measured: its class need not be importable."""

    @dataclass(frozen=True, kw_only=True)
    class Typed(OpenLoop):
        name: ClassVar[str] = "typed"

        def inputs(self, system: System, rng: np.random.Generator) -> Array:
            return rng.uniform(-1.0, 1.0, (system.horizon, system.n_inputs))

    with explorer(policy=Typed()) as one:
        drive(one, 3)
        assert one.save(sqlite_url)
    assert content(sqlite_url)["n_steps"] == 3


@pytest.mark.parametrize("closed", [False, True])
def test_saved_on_the_way_is_saved_at_the_end(
    closed: bool, url: str, tmp_path: Path, run: Explorer
) -> None:
    for steps in (0, 1, 3, 130):
        drive(run, steps)
        run.save(url)
    end = f"sqlite:///{tmp_path}/end.db"
    if closed:
        run.close()
    run.save(end)
    assert content(url) == content(end)
    assert not examine(url)


def test_beside_a_trial_of_the_same_system_it_is_another_configuration(sqlite_url: str) -> None:
    system = dopt.SYSTEMS["pendulum"](horizon=30)
    spec = TrialSpec.of_system(system, "d_optimal")
    trial = dopt.run_trial(spec)
    with Explorer(system) as one:
        drive_through(one, trial.states)
        one.save(sqlite_url)
    assert content(sqlite_url)["trial_key"] != spec.trial_key
    with Store.open(sqlite_url) as store:
        launch, [claim] = begin(store, spec)
        assert store.commit(claim, trial, RUN)
        store.end_launch(launch, "done")
    with Reader.open(sqlite_url) as reader:
        selection = select(reader, Filter())
    assert [entry.config.config_key for entry in selection.entries] == [spec.config_key]
    assert selection.notes == ("pendulum: 1 other stored configuration left out (see --where)",)
    assert not examine(sqlite_url)


def test_the_error_on_a_test_run_is_stored(sqlite_url: str, run: Explorer) -> None:
    with explorer(seed=1) as other:
        drive(other, 120)
        test = other.states, other.inputs
    run.save(sqlite_url, test=test)
    assert content(sqlite_url)["assessed"] == [(40, "free_run_error", run.free_run_error(*test))]
    drive(run, 10)
    run.save(sqlite_url)
    assert [t for t, *_ in content(sqlite_url)["assessed"]] == [40], "what was stored stays"
    run.save(sqlite_url, test=test)
    assert content(sqlite_url)["assessed"] == [(50, "free_run_error", run.free_run_error(*test))]
    with pytest.raises(SpecificationError, match="was given for predictions"):
        run.save(sqlite_url, test=(test[0], test[1][:5]))
    with pytest.raises(SpecificationError, match="a pair"):
        run.save(sqlite_url, test=run.states)  # type: ignore[arg-type]


def test_fewer_steps_of_the_same_run_are_left_out(sqlite_url: str, run: Explorer) -> None:
    run.save(sqlite_url)
    before = content(sqlite_url)
    with explorer() as other:
        drive(other, 15)
        assert not other.save(sqlite_url)
        assert content(sqlite_url) == before
        drive(other, 45)
        assert other.save(sqlite_url)
    assert content(sqlite_url)["n_steps"] == 60
    assert run.save(sqlite_url) is False, "the other one has gone further"


def test_after_a_kill_the_journal_goes_on_with_the_same_trial(url: str, tmp_path: Path) -> None:
    """What a kill leaves is the journal and a session that nobody has ended."""
    with explorer(journal=tmp_path / "run.jsonl") as killed:
        for _ in range(3):
            drive(killed, 20)
            killed.save(url)
        before = content(url)
        shutil.copy(tmp_path / "run.jsonl", tmp_path / "left.jsonl")
        with explorer(journal=tmp_path / "left.jsonl") as again:
            assert again.n_steps == before["n_steps"] == 60
            again.save(url)
            assert content(url) == before
            drive(again, 10)
            again.save(url)
        after = content(url)
    assert after["trial_key"] == before["trial_key"]
    assert after["steps"][:60] == before["steps"]
    assert after["n_steps"] == 70


def test_a_save_that_fails_in_the_middle_leaves_what_was_stored(
    url: str, run: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.save(url)
    before = content(url)
    drive(run, 20)

    def fail(*_: object) -> None:
        raise OperationalError("INSERT", {}, sqlite3.OperationalError("disk I/O error"))

    with monkeypatch.context() as broken:
        broken.setattr(writing, "_replace_arrays", fail)
        with pytest.raises(StoreUnavailableError, match=r"^The results database .* \(disk I/O"):
            run.save(url)
    assert content(url) == before
    drive(run, 20)
    assert run.save(url)
    assert content(url)["n_steps"] == 80
    assert not examine(url)


def test_a_locked_database_is_said_and_the_exploration_goes_on(
    sqlite_url: str, monkeypatch: pytest.MonkeyPatch, run: Explorer
) -> None:
    opening = partial(Store.open, patience=0.05)
    monkeypatch.setattr("orchestrate.runner.saving.Store.open", opening)
    run.save(sqlite_url)
    before = content(sqlite_url)
    other = sqlite3.connect(sqlite_url.removeprefix("sqlite:///"), isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    drive(run, 10)
    with pytest.raises(StoreUnavailableError, match=r"has locked it for more than 0.05 s"):
        run.save(sqlite_url)
    assert content(sqlite_url) == before
    drive(run, 10)
    other.execute("ROLLBACK")
    other.close()
    assert run.save(sqlite_url)
    assert content(sqlite_url)["n_steps"] == 60


def test_without_orchestrate_that_is_said(run: Explorer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "orchestrate.runner.saving", None)
    with pytest.raises(DoptError, match=r"saved by the package orchestrate, .*: install dopt"):
        run.save("sqlite:///results.db")


def test_a_reader_sees_whole_runs_while_another_thread_saves(url: str) -> None:
    seen: list[int] = []
    with explorer() as one:
        drive(one, 1)
        one.save(url)
        ended = threading.Event()

        def save() -> None:
            while not ended.is_set():
                one.save(url)

        thread = threading.Thread(target=save)
        thread.start()
        try:
            while one.n_steps < STEPS:
                drive(one, 1)
                if one.n_steps % 10 == 0:
                    found = content(url)
                    states, inputs, _ = found["arrays"]
                    seen.append(found["n_steps"])
                    assert len(found["steps"]) == len(inputs) == len(states) - 1 == seen[-1]
                    assert [loss for _, loss, _ in found["steps"]] == list(one.errors[: seen[-1]])
        finally:
            ended.set()
            thread.join()
        one.save(url)
    assert seen == sorted(seen)
    assert content(url)["n_steps"] == STEPS


def test_parameters_that_are_not_finite_end_it_as_diverged(sqlite_url: str) -> None:
    with explorer(learner={"name": "adam_window", "learning_rate": 1e300}) as one:
        drive(one, 1)
        one.save(sqlite_url)
        with pytest.raises(DoptError, match="not finite"):
            drive(one, 50)
        one.save(sqlite_url)
        at = one.n_steps - 1
    with Reader.open(sqlite_url) as reader:
        [config] = reader.configs()
        [trial] = reader.trials(config.config_key)
        curves = reader.curves(config.config_key)
    assert (trial.status, trial.diverged_at, trial.n_steps) == ("diverged", at, at)
    assert np.array_equal(np.isfinite(curves.values[0]), np.arange(STEPS) < at)
    assert not examine(sqlite_url)
    with Store.open(sqlite_url) as store:
        assert store.retry("all") == 0, "no launch can run it again"


def test_no_launch_takes_it(url: str, run: Explorer) -> None:
    run.save(url)
    before = content(url)
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        assert store.recover() == 0
        assert store.claim(launch, [before["trial_key"]]) == []
        assert store.retry("all") == 0
    assert content(url) == before
