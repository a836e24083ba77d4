"""A bundle in the place of a database: opened, checked, and only read."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.__main__ import main
from orchestrate.store import NoDatabaseError, Reader, SchemaVersionError, Store, StoreError
from orchestrate.store.bundles import cached, checksums
from orchestrate.store.schema import SCHEMA_VERSION
from tests.orchestrate.commands.conftest import BUNDLE_FILES, Answer

Run = Callable[..., Answer]
pytestmark = pytest.mark.usefixtures("copies")


class TestOpening:
    def test_every_form_of_its_name(self, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(bundle.parent)
        for name in (f"bundle:///{bundle}", "bundle:///bundle", str(bundle), "bundle"):
            with Reader.open(name) as reader:
                assert reader.safe_url.startswith("bundle:///")
                assert len(reader.configs()) == 5

    @pytest.mark.parametrize("name", BUNDLE_FILES)
    def test_a_damaged_file_is_named(self, bundle: Path, name: str, copies: Path) -> None:
        Reader.open(str(bundle)).close()  # a copy is no reason to leave the check out
        assert len(list(copies.glob("*.db"))) == 1
        content = bytearray((bundle / name).read_bytes())
        content[len(content) // 2] ^= 1
        (bundle / name).write_bytes(content)
        with pytest.raises(StoreError, match=f"{name} of the bundle is damaged.*SHA-256"):
            Reader.open(str(bundle))
        (bundle / name).unlink()
        with pytest.raises(StoreError, match=f"{name} of the bundle.*is missing"):
            Reader.open(str(bundle))

    def test_a_damaged_list_of_checksums_is_refused(self, bundle: Path) -> None:
        listed = bundle / checksums.CHECKSUMS
        listed.write_text(listed.read_text()[10:])
        with pytest.raises(StoreError, match="SHA256SUMS is damaged"):
            Reader.open(str(bundle))

    def test_a_table_that_is_not_listed_is_refused(self, bundle: Path) -> None:
        listed = bundle / checksums.CHECKSUMS
        lines = [line for line in listed.read_text().splitlines() if "step" not in line]
        listed.write_text("\n".join(lines))
        with pytest.raises(StoreError, match=r"step\.parquet"):
            Reader.open(str(bundle))

    def test_a_file_with_other_columns_is_refused(self, bundle: Path) -> None:
        shutil.copy(bundle / "error.parquet", bundle / "step.parquet")
        checksums.write(bundle)
        with pytest.raises(StoreError, match=r"columns of .*step\.parquet"):
            Reader.open(str(bundle))
        (bundle / "step.parquet").write_text("no Parquet")
        checksums.write(bundle)
        with pytest.raises(StoreError, match=r"step\.parquet of the bundle is no Parquet file"):
            Reader.open(str(bundle))

    def test_another_schema_is_refused(self, bundle: Path) -> None:
        path = bundle / "provenance.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": "3"}))
        checksums.write(bundle)
        with pytest.raises(
            SchemaVersionError, match=f"has schema 3, this program reads schema {SCHEMA_VERSION}"
        ):
            Reader.open(str(bundle))

    def test_what_is_no_bundle_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(NoDatabaseError, match="There is no folder"):
            Reader.open(f"bundle:///{tmp_path}/nothing")
        with pytest.raises(StoreError, match="is no bundle, because it has no file SHA256SUMS"):
            Reader.open(str(tmp_path))
        with pytest.raises(StoreError, match="names no folder"):
            Reader.open("bundle://")
        with pytest.raises(StoreError, match=r"has none: write three slashes, bundle:///here/x\."):
            Reader.open("bundle://here/x")

    def test_it_is_imported_once(self, bundle: Path, copies: Path) -> None:
        for _ in range(2):
            Reader.open(str(bundle)).close()
        (copy,) = copies.glob("*.db")
        made = copy.stat().st_ino
        old = copies / "old.db"
        old.touch()
        os.utime(old, times=(0, time.time() - 86_400 * (cached.DAYS_KEPT + 1)))
        Reader.open(str(bundle)).close()
        assert (copy.stat().st_ino, old.exists()) == (made, True)
        copy.unlink()
        Reader.open(str(bundle)).close()
        assert sorted(path.name for path in copies.iterdir()) == sorted([copy.name, "lock"])


class TestWriting:
    def test_it_is_refused_with_what_to_do(self, bundle: Path) -> None:
        with pytest.raises(StoreError, match=r"only read.*orchestrate merge bundle:///"):
            Store.open(f"bundle:///{bundle}")

    @pytest.mark.parametrize("words", [("retry", "failed"), ("upgrade",), ("merge", "other")])
    def test_every_command_that_writes_refuses_it(
        self, bundle: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
    ) -> None:
        given = [str(bundle) if word == "other" else word for word in words]
        files = {path.name: path.read_bytes() for path in bundle.iterdir()}
        other = shutil.copytree(bundle, bundle.parent / "second")
        assert main([*given, "--db", str(other)]) == 2
        assert "is a bundle, which is only read" in capsys.readouterr().err
        assert files == {path.name: path.read_bytes() for path in other.iterdir()}

    def test_a_query_cannot_write(self, bundle: Path) -> None:
        with Reader.open(str(bundle)) as reader, pytest.raises(StoreError, match="only a SELECT"):
            reader.query("DELETE FROM trial")
