"""A bundle is checked and imported into a database by ``merge``, and is no database itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.__main__ import main
from orchestrate.store import Reader, SchemaVersionError, Store, StoreError
from orchestrate.store.bundle import CHECKSUMS, merge_bundle, write_checksums
from tests.orchestrate.commands.conftest import BUNDLE_FILES

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
