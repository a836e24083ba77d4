"""``export``: the numbers of the database, bit for bit, whole or not at all."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
import yaml

from orchestrate.__main__ import main
from orchestrate.errors import without_password
from orchestrate.export import bundle as writing
from orchestrate.export import tables
from orchestrate.export.bundle import COLUMNS, TABLE_TITLES
from orchestrate.store import Claim, Reader, SchemaVersionError, Store, StoreError
from orchestrate.store.bundle import (
    CHECKSUMS,
    TABLES,
    arrow_schema,
    fill,
    merge_bundle,
    primary_key,
    write_checksums,
)
from tests.orchestrate.commands.conftest import (
    BAD,
    BUNDLE_FILES,
    DONE,
    SECRET,
    Answer,
    on_both,
    run_now,
)
from tests.orchestrate.store.fakes import (
    HORIZON,
    LAUNCH,
    Spec,
    assessed,
    diverged,
    everything,
    result,
)
from tests.paths import ROOT, without_coverage

Run = Callable[..., Answer]
FORMATS = ("csv", "parquet", "npz")
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
        out = tmp_path / "assessments.npz"
        assert command("export", "assessments", "--out", str(out)).code == 0
        with np.load(out) as arrays:
            costs = [row.value for row in expected if row.measure == "cost"]
            (name,) = (name for name in arrays if name.endswith("/cost"))
            np.testing.assert_array_equal(arrays[name], [costs])
            np.testing.assert_array_equal(arrays[f"{name}/t"], [0, 3, 7])

    def test_null_is_null_in_parquet(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "curves.parquet"
        command("export", "curves", "--out", str(out))
        assert pyarrow.parquet.read_table(out)["loss"].null_count == HORIZON - 3


@pytest.mark.usefixtures("grid")
class TestMatrices:
    def load(self, command: Run, kind: str, out: Path) -> dict[str, Any]:
        assert command("export", kind, "--out", str(out)).code == 0
        with np.load(out, allow_pickle=False) as arrays:
            return dict(arrays)

    def test_curves(self, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "curves.npz"
        arrays = self.load(command, "curves", out)
        np.testing.assert_array_equal(arrays["pendulum/random/16/seed"], [0, 1, 2])
        for name in VALUES:
            expected = np.stack([getattr(RESULTS[spec], name) for spec in DONE])
            np.testing.assert_array_equal(arrays[f"pendulum/random/16/{name}"], expected)
        np.testing.assert_array_equal(arrays["pendulum/d_optimal/16/diverged"], [True])
        loss = arrays["pendulum/d_optimal/16/loss"]
        np.testing.assert_array_equal(loss, [diverged(3, seed=BAD.seed).loss])
        assert arrays["cartpole/random/-/loss"].shape == (0, HORIZON)
        described = manifest(out)["arrays"]
        assert described.keys() == arrays.keys()
        axes = described["pendulum/random/16/loss"]
        assert axes == {"axes": ["seed", "t"], "shape": [3, HORIZON], "dtype": "float64"}

    @on_both
    def test_trajectories(self, command: Run, tmp_path: Path) -> None:
        arrays = self.load(command, "trajectories", tmp_path / "trajectories.npz")
        for name in ("states", "inputs", "parameters"):
            expected = np.stack([getattr(RESULTS[spec], name) for spec in DONE])
            np.testing.assert_array_equal(arrays[f"pendulum/random/16/{name}"], expected)
        assert "cartpole/random/8/states" not in arrays

    def test_trials(self, command: Run, tmp_path: Path) -> None:
        arrays = self.load(command, "trials", tmp_path / "trials.npz")
        assert {array.shape for array in arrays.values()} == {(9,)}
        assert arrays["seed"].dtype == np.int64
        (place,) = np.flatnonzero(arrays["trial_key"] == DONE[1].trial_key)
        assert arrays["final_loss"][place] == RESULTS[DONE[1]].final_loss
        assert np.isnan(arrays["final_loss"][arrays["status"] == "pending"]).all()

    def test_configurations_of_the_same_name_have_their_key(
        self, store: Store, command: Run, tmp_path: Path
    ) -> None:
        longer = Spec(0, policy="random", horizon=9)
        store.register(store.begin_launch(LAUNCH), [longer])
        names = self.load(command, "curves", tmp_path / "curves.npz")
        for spec in (longer, DONE[0]):
            assert f"pendulum/random/16/{spec.config_key[:12]}/loss" in names


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
        assert len(files) == 6
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


@contextmanager
def opened(bundle: Path) -> Iterator[Reader]:
    """Open a database with exactly the rows of a bundle."""
    with tempfile.TemporaryDirectory() as folder:
        fill(Path(folder) / "copy.db", bundle)
        with Reader.open(f"sqlite:///{folder}/copy.db") as reader:
            yield reader


def rows(reader: Reader, table: str) -> list[list[object]]:
    names, order = ", ".join(arrow_schema(table).names), ", ".join(primary_key(table))
    found = reader.rows(f"SELECT {names} FROM {table} ORDER BY {order}")
    return [[bytes(x) if isinstance(x, memoryview) else x for x in row] for row in found]


@on_both
class TestRoundTrip:
    def test_every_row_of_every_table_is_the_same(self, bundle: Path, url: str) -> None:
        with Reader.open(url) as there, opened(bundle) as here:
            for table in TABLES:
                expected = rows(there, table)
                if table == "launch":  # its command line held a password
                    expected = [
                        [without_password(x) if isinstance(x, str) else x for x in row]
                        for row in expected
                    ]
                assert repr(rows(here, table)) == repr(expected), table

    def test_every_number_has_the_same_bits(self, bundle: Path, url: str) -> None:
        with Reader.open(url) as there, opened(bundle) as here:
            assert here.configs() == there.configs()
            for config in there.configs():
                key = config.config_key
                for column in ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us"):
                    one, other = (reader.curves(key, column) for reader in (there, here))
                    assert one.values.tobytes() == other.values.tobytes()
                assert there.trials(key) == here.trials(key)
                for trial in there.trials(key):
                    if trial.status in ("done", "diverged"):
                        one, other = (
                            reader.trajectory(key, trial.seed) for reader in (there, here)
                        )
                        for name in ("states", "inputs", "parameters"):
                            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()

    def test_a_bundle_of_a_bundle_is_the_same(self, bundle: Path, tmp_path: Path) -> None:
        again = tmp_path / "again"
        fill(tmp_path / "copy.db", bundle)
        assert main(["export", "bundle", str(again), "--db", f"sqlite:///{tmp_path}/copy.db"]) == 0
        for table in TABLES:
            name = f"{table}.parquet"
            assert (again / name).read_bytes() == (bundle / name).read_bytes()

    def test_its_results_can_be_merged_into_a_database(
        self, bundle: Path, url: str, tmp_path: Path
    ) -> None:
        copies = [f"sqlite:///{tmp_path}/{name}.db" for name in ("of_bundle", "of_database")]
        for target, other in zip(copies, (str(bundle), url), strict=True):
            assert main(["merge", other, "--db", target]) == 0
        one, other = map(everything, copies)
        assert one[0] == other[0]
        assert one[1:4] == other[1:4]


class TestFiles:
    def test_sha256sum_accepts_all_of_them(self, bundle: Path) -> None:
        done = subprocess.run(
            ["sha256sum", "--check", "--strict", "SHA256SUMS"],
            cwd=bundle,
            capture_output=True,
            text=True,
            check=True,
        )
        assert sorted(done.stdout.split(": OK\n")[:-1]) == sorted(BUNDLE_FILES)
        assert {path.name for path in bundle.iterdir()} == {*BUNDLE_FILES, "SHA256SUMS"}

    def test_pandas_reads_states_as_lists(self, bundle: Path) -> None:
        trials = pd.read_parquet(bundle / "trial.parquet")
        paths = pd.read_parquet(bundle / "trajectory.parquet").set_index("trial_id")
        assert len(paths) == 7
        for spec in DONE:
            (number,) = trials[trials.trial_key == spec.trial_key].trial_id
            np.testing.assert_array_equal(np.stack(paths.states[number]), result(spec.seed).states)

    def test_the_card_has_a_header_and_every_column(self, bundle: Path, command: Run) -> None:
        assert command("export", "bundle", str(bundle), "--license", "cc-by-4.0").code == 0
        _, header, text = (bundle / "README.md").read_text().split("---\n", 2)
        facts = yaml.safe_load(header)
        assert facts["license"] == "cc-by-4.0"
        assert facts["size_categories"] == ["n<1K"]
        assert {one["config_name"] for one in facts["configs"]} == set(TABLES)
        assert "12 trials (5 done, " in text
        assert "commit 000000000000 with changes" in text
        for table in TABLES:
            for name in arrow_schema(table).names:
                assert f"| `{name}` |" in text

    def test_the_provenance_says_what_was_run(self, bundle: Path, grid: int) -> None:
        facts = json.loads((bundle / "provenance.json").read_text())
        (launch,) = facts["launches"]
        assert (launch["launch_id"], launch["git_commit"]) == (grid, "0" * 40)
        assert launch["git_dirty"] is True
        assert launch["versions"] == {"numpy": np.__version__}
        assert facts["filters"] == {"env": [], "policy": []}
        assert facts["rows"]["step"] == 7 * HORIZON
        assert {"command", "written", "program", "schema_version", "versions"} <= facts.keys()

    def test_passwords_appear_nowhere(self, bundle: Path) -> None:
        for path in bundle.iterdir():
            assert SECRET.encode() not in path.read_bytes()

    def test_filters_leave_the_rest_out(self, bundle: Path, command: Run, tmp_path: Path) -> None:
        out = tmp_path / "part"
        words = ("export", "bundle", "--env", "pendulum", "--policy", "d_optimal", "--json")
        document = command(*words, "--out", str(out)).document
        assert document["filters"] == {"env": ["pendulum"], "policy": ["d_optimal"]}
        assert document["rows"]["trial"] == 3
        assert document["rows"]["error"] == 2
        assert document["bytes"] == sum(path.stat().st_size for path in out.iterdir())
        with opened(out) as reader, opened(bundle) as whole:
            assert [config.policy for config in reader.configs()] == ["d_optimal"]
            key = BAD.config_key
            assert reader.trials(key) == whole.trials(key)


def test_every_column_of_the_schema_is_described() -> None:
    assert set(TABLE_TITLES) == set(TABLES)
    for table in TABLES:
        assert list(COLUMNS[table]) == arrow_schema(table).names


class TestWholeOrNotAtAllBundle:
    def test_an_earlier_bundle_is_replaced(self, bundle: Path, command: Run) -> None:
        assert command("export", "bundle", str(bundle), "--env", "cartpole").code == 0
        with opened(bundle) as reader:
            assert {config.env for config in reader.configs()} == {"cartpole"}
        assert [path.name for path in bundle.parent.glob(".*")] == []

    def test_another_folder_is_not(self, bundle: Path, command: Run, tmp_path: Path) -> None:
        other = tmp_path / "mine"
        other.mkdir()
        (other / "notes.txt").write_text("keep")
        for out in (other, other / "notes.txt"):
            answer = command("export", "bundle", str(out))
            assert answer.code == 2
            assert "is there already and is no earlier export of this kind" in answer.err
        assert (other / "notes.txt").read_text() == "keep"
        assert bundle.exists()

    @pytest.mark.usefixtures("grid")
    def test_an_error_leaves_nothing(
        self, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(_: Path) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(writing, "write_checksums", full)
        before = sorted(tmp_path.iterdir())
        answer = command("export", "bundle", str(tmp_path / "out"))
        assert answer.code == 2
        assert "cannot be written (No space left on device)" in answer.err
        assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("grid")
class TestWords:
    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (("bundle",), "No path is given to write to"),
            (("bundle", "a", "--out", "b"), "Two paths are given to write to"),
            (("bundle", "a", "--format", "csv"), "--format is for files"),
            (("curves", "a.csv", "--license", "mit"), "--license is for the card of a bundle"),
            (("bundle", "a", "--license", "My own"), "an identifier in lower case is expected"),
            (("bundel", "a"), "did you mean 'bundle'"),
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


def test_an_empty_database_has_no_bundle(store: Store, command: Run, tmp_path: Path) -> None:
    assert store.safe_url
    answer = command("export", "bundle", str(tmp_path / "out"))
    assert answer.code == 2
    assert "holds no trials yet" in answer.err


def test_trials_without_results_are_kept(
    take: Callable[..., list[Claim]], command: Run, tmp_path: Path
) -> None:
    take(Spec(0))
    out = tmp_path / "out"
    assert command("export", "bundle", str(out)).code == 0
    with opened(out) as reader:
        assert [trial.status for trial in reader.trials(Spec(0).config_key)] == ["running"]
        assert [launch.alive for launch in reader.launches()] == [False]


Import = Callable[[], object]


@pytest.fixture
def target(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/target.db"


@pytest.fixture
def imported(bundle: Path, target: str) -> Import:
    """Return a function that imports the bundle into an empty database."""
    return lambda: merge_bundle(target, bundle)


@pytest.mark.parametrize("name", BUNDLE_FILES)
def test_a_damaged_file_is_named(bundle: Path, name: str, imported: Import) -> None:
    content = bytearray((bundle / name).read_bytes())
    content[len(content) // 2] ^= 1
    (bundle / name).write_bytes(content)
    with pytest.raises(StoreError, match=f"{name} of the bundle is damaged.*SHA-256"):
        imported()
    (bundle / name).unlink()
    with pytest.raises(StoreError, match=f"{name} of the bundle.*is missing"):
        imported()


def test_a_damaged_list_of_checksums_is_refused(bundle: Path, imported: Import) -> None:
    listed = bundle / CHECKSUMS
    listed.write_text(listed.read_text()[10:])
    with pytest.raises(StoreError, match="SHA256SUMS is damaged"):
        imported()


def test_a_table_that_is_not_listed_is_refused(bundle: Path, imported: Import) -> None:
    listed = bundle / CHECKSUMS
    lines = [line for line in listed.read_text().splitlines() if "step" not in line]
    listed.write_text("\n".join(lines))
    with pytest.raises(StoreError, match=r"step\.parquet"):
        imported()


def test_a_file_with_other_columns_is_refused(bundle: Path, imported: Import) -> None:
    shutil.copy(bundle / "error.parquet", bundle / "step.parquet")
    write_checksums(bundle)
    with pytest.raises(SchemaVersionError, match=r"columns of .*step\.parquet"):
        imported()
    (bundle / "step.parquet").write_text("no Parquet")
    write_checksums(bundle)
    with pytest.raises(StoreError, match=r"step\.parquet of the bundle is no Parquet file"):
        imported()


def test_what_is_no_bundle_is_refused(tmp_path: Path, target: str) -> None:
    with pytest.raises(StoreError, match="is no bundle, because it has no file SHA256SUMS"):
        merge_bundle(target, tmp_path)


@pytest.mark.parametrize("side", [Store, Reader])
def test_it_is_no_database(
    bundle: Path, monkeypatch: pytest.MonkeyPatch, side: type[Store | Reader]
) -> None:
    monkeypatch.chdir(bundle.parent)
    for name in (f"bundle:///{bundle}", "bundle:///bundle", str(bundle), "bundle"):
        with pytest.raises(StoreError, match=r"is a folder, .*orchestrate merge .*bundle --db URL"):
            side.open(name)


def test_a_damaged_bundle_changes_no_database(
    bundle: Path, target: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Store.open(target).close()
    (bundle / "step.parquet").unlink()
    assert main(["merge", str(bundle), "--db", target]) != 0
    assert "step.parquet" in capsys.readouterr().err
    with Reader.open(target) as reader:
        assert reader.configs() == []
