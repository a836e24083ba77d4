"""``export``: the numbers of the database, bit for bit, whole or not at all."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

from orchestrate.commands import export as tables
from orchestrate.store import Claim, Reader, Store
from tests.orchestrate.commands.conftest import BAD, DONE, SECRET, Answer, on_both, run_now
from tests.orchestrate.store.fakes import HORIZON, Spec, assessed, diverged, result
from tests.paths import ROOT, without_coverage

Run = Callable[..., Answer]
FORMATS = ("csv", "parquet")
NO_ROOM = """
import resource, sys
sys.dont_write_bytecode = True  # a file that is cut would stay
from orchestrate.__main__ import main
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
sys.exit(main())
"""
VALUES = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")
RESULTS = {**{spec: result(spec.seed) for spec in DONE}, BAD: diverged(3, seed=BAD.seed)}


def read(path: Path) -> pd.DataFrame:
    if path.suffix == ".csv":
        return pd.read_csv(path)
    return pyarrow.parquet.read_table(path).to_pandas()


def manifest(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(Path(f"{path}.manifest.json").read_text())
    return document


@pytest.mark.usefixtures("grid")
class TestTables:
    @on_both
    @pytest.mark.parametrize("ending", ["csv", "parquet"])
    def test_curves(self, command: Run, tmp_path: Path, ending: str) -> None:
        out = tmp_path / f"curves.{ending}"
        answer = command("export", "curves", "--out", str(out))
        assert (answer.code, answer.err) == (0, "")
        frame = read(out)
        assert len(frame) == len(RESULTS) * HORIZON
        for spec, expected in RESULTS.items():
            chosen = frame[(frame.policy == spec.policy) & (frame.seed == spec.seed)]
            assert chosen.t.tolist() == list(range(HORIZON))
            for name in VALUES:
                np.testing.assert_array_equal(chosen[name], getattr(expected, name))
        assert set(frame[frame.seed == BAD.seed].status) == {"diverged"}
        assert set(frame.width) == {16}

    @pytest.mark.parametrize("ending", ["csv", "parquet"])
    def test_trials(self, command: Run, tmp_path: Path, ending: str) -> None:
        out = tmp_path / f"trials.{ending}"
        assert command("export", "trials", "--out", str(out)).code == 0
        frame = read(out).set_index("trial_key")
        assert len(frame) == 9
        assert frame.status.value_counts().to_dict() == {
            **{"done": 3, "failed": 2, "pending": 2, "running": 1, "diverged": 1}
        }
        for spec, expected in RESULTS.items():
            row = frame.loc[spec.trial_key]
            assert (row.config_key, row.seed) == (spec.config_key, spec.seed)
            assert row.best_loss == expected.best_loss
        assert frame.loc[BAD.trial_key].diverged_at == 3
        assert set(frame.error_message.dropna()) == {"seed 3 is broken", "seed 4 is broken"}

    @pytest.mark.parametrize("ending", ["csv", "parquet"])
    def test_trajectories(self, command: Run, tmp_path: Path, ending: str) -> None:
        out = tmp_path / f"trajectories.{ending}"
        assert command("export", "trajectories", "--out", str(out)).code == 0
        frame = read(out)
        assert len(frame) == len(RESULTS) * (HORIZON + 1)
        for spec, expected in RESULTS.items():
            chosen = frame[(frame.policy == spec.policy) & (frame.seed == spec.seed)]
            states = chosen[[f"state_{i}" for i in range(4)]]
            np.testing.assert_array_equal(states, expected.states)
            inputs = chosen[["input_0", "input_1"]]
            np.testing.assert_array_equal(inputs[:-1], expected.inputs)
            assert inputs.iloc[-1].isna().all()  # nothing is applied at the end

    def test_assessments(self, command: Run, tmp_path: Path, store: Store, grid: int) -> None:
        refused = command("export", "assessments", "--out", str(tmp_path / "none.csv"))
        assert refused.code != 0
        assert "task=control" in refused.err
        (claim,) = store.claim(grid, store.register(grid, [Spec(9)]).todo)
        store.commit(claim, assessed(9), run_now())
        expected = assessed(9).assessments
        for ending in ("csv", "parquet"):
            out = tmp_path / f"assessments.{ending}"
            assert command("export", "assessments", "--out", str(out)).code == 0
            frame = read(out)
            assert [*frame.measure] == [row.measure for row in expected]
            assert [*frame.t] == [row.t for row in expected]
            assert [*frame.value][:-1] == [row.value for row in expected][:-1]
            assert np.isnan([*frame.value][-1])

    def test_every_table_is_joined_by_the_columns_of_the_views(
        self, command: Run, tmp_path: Path, url: str
    ) -> None:
        """No column has another name than in the database."""
        with Reader.open(url) as reader:
            views = ("v_trial", "v_curve", "step")
            firsts = [next(iter(reader.rows(f"SELECT * FROM {name} LIMIT 1"))) for name in views]
        known = {name for row in firsts for name in row._fields}
        tables = {}
        for kind in ("trials", "curves", "trajectories"):
            command("export", kind, "--out", str(tmp_path / f"{kind}.parquet"))
            tables[kind] = read(tmp_path / f"{kind}.parquet")
            own = {name for name in tables[kind] if not name.startswith(("state_", "input_"))}
            assert own <= known
        for kind, rows in (("curves", HORIZON), ("trajectories", HORIZON + 1)):
            joined = tables[kind].merge(tables["trials"], on=["config_key", "seed"])
            assert joined.groupby("trial_key").size().to_dict() == {
                spec.trial_key: rows for spec in RESULTS
            }

    def test_null_is_null_in_parquet(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "curves.parquet"
        command("export", "curves", "--out", str(out))
        assert pyarrow.parquet.read_table(out)["loss"].null_count == HORIZON - 3


@pytest.mark.usefixtures("grid")
class TestManifest:
    @pytest.mark.parametrize("ending", FORMATS)
    def test_it_says_where_the_numbers_come_from(
        self, command: Run, tmp_path: Path, grid: int, ending: str
    ) -> None:
        out = tmp_path / f"curves.{ending}"
        words = ("export", "curves", "--out", str(out), "--env", "pendulum", "--json")
        printed = command(*words).document
        document = manifest(out)
        assert document == printed
        assert document["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
        assert document["bytes"] == out.stat().st_size
        assert document["filters"] == {"env": ["pendulum"], "policy": []}
        assert document["trials"]["done"] == 3
        assert set(document["configs"]) == {DONE[0].config_key, BAD.config_key}
        assert document["configs"][BAD.config_key] == BAD.columns()
        (launch,) = document["launches"]
        assert (launch["launch_id"], launch["git_commit"]) == (grid, "0" * 40)

    def test_passwords_appear_nowhere(self, command: Run, tmp_path: Path) -> None:
        for ending in FORMATS:
            command("export", "trials", "--out", str(tmp_path / f"trials.{ending}"))
        files = [path for path in tmp_path.iterdir() if path.name.startswith("trials.")]
        assert len(files) == 4
        for path in files:
            assert SECRET.encode() not in path.read_bytes()


@pytest.mark.usefixtures("grid")
class TestWholeOrNotAtAll:
    def left(self, folder: Path) -> list[str]:
        return sorted(path.name for path in folder.iterdir())

    def test_a_full_disk_leaves_the_old_file(self, command: Run, url: str, tmp_path: Path) -> None:
        out = tmp_path / "out" / "curves.csv"
        command("export", "curves", "--out", str(out))
        before = out.read_bytes()
        program = [sys.executable, "-c", NO_ROOM, "export", "curves", "--out", str(out)]
        done = subprocess.run(
            [*program, "--db", url],
            cwd=ROOT,
            env=without_coverage(),  # which writes files of its own
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2
        assert "cannot be written" in done.stderr
        assert done.stderr.count("\n") == 1
        assert out.read_bytes() == before
        assert self.left(out.parent) == ["curves.csv", "curves.csv.manifest.json"]

    def test_a_place_that_cannot_be_written_is_one_sentence(
        self, command: Run, tmp_path: Path
    ) -> None:
        (tmp_path / "file").write_text("in the way")
        answer = command("export", "curves", "--out", str(tmp_path / "file" / "curves.csv"))
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        (tmp_path / "curves.csv").mkdir()
        answer = command("export", "curves", "--out", str(tmp_path / "curves.csv"))
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert not [name for name in self.left(tmp_path) if "partial" in name]

    def test_nothing_done_is_nothing_to_export(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "curves.csv"
        answer = command("export", "curves", "--out", str(out), "--env", "cartpole")
        assert answer.code == 2
        assert "No trial of these is done yet" in answer.err
        assert not out.exists()


def test_batches_join_without_a_seam(
    store: Store,
    take: Callable[..., list[Claim]],
    command: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tables, "ROWS", 3)
    for claim in take(*(Spec(seed) for seed in range(5))):
        store.commit(claim, result(claim.trial_id), run_now())
    for ending in ("csv", "parquet"):
        out = tmp_path / f"curves.{ending}"
        command("export", "curves", "--out", str(out))
        frame = read(out)
        assert frame[["seed", "t"]].drop_duplicates().shape == (5 * HORIZON, 2)
        out = tmp_path / f"trajectories.{ending}"
        command("export", "trajectories", "--out", str(out))
        assert len(read(out)) == 5 * (HORIZON + 1)


@pytest.mark.usefixtures("grid")
class TestWords:
    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (("curves",), "No path is given to write to"),
            (("curves", "a.csv", "--out", "b.csv"), "Two paths are given to write to"),
            (("curvse", "a.csv"), "did you mean 'curves'"),
            (("curves", "a.npz"), "'export npz' was removed: analysis.load() gives"),
            (("curves", "a.csv", "--format", "npz"), "'export npz' was removed"),
            (("bundle", "a"), "'export bundle' was removed: copy trials into a file with"),
        ],
    )
    def test_a_mistake_is_one_sentence(
        self, command: Run, words: tuple[str, ...], said: str
    ) -> None:
        answer = command("export", *words)
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert said in answer.err

    def test_a_file_may_be_named_without_an_option(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "curves.csv"
        assert command("export", "curves", str(out)).code == 0
        assert out.exists()
