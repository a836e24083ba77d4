"""``export bundle``: the whole database as files, bit for bit."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from orchestrate.__main__ import main
from orchestrate.errors import without_password
from orchestrate.export import bundle as writing
from orchestrate.export.bundle import COLUMNS, TABLE_TITLES
from orchestrate.store import Claim, Reader, Store
from orchestrate.store.bundle import TABLES, arrow_schema, fill, primary_key
from tests.orchestrate.commands.conftest import BAD, BUNDLE_FILES, DONE, ODD, SECRET, Answer
from tests.orchestrate.store.everything import everything
from tests.orchestrate.store.fakes import HORIZON, Spec, result

Run = Callable[..., Answer]


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

    def test_the_odd_numbers_are_in_it(self, bundle: Path) -> None:
        with opened(bundle) as reader:
            found = reader.trajectory(Spec(20).config_key, 20)
        np.testing.assert_array_equal(found.states[:4, 0], ODD)
        assert np.signbit(found.states[0, 0])

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


class TestWholeOrNotAtAll:
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
