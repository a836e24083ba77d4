"""A SQLite file that loses its name while it is open is saved, and no other one is written."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path, PurePosixPath

import pytest
from sqlalchemy import make_url

from orchestrate.errors import StoreError
from orchestrate.store import Claim, DatabaseMovedError, Failure, Reader, Store, sqlite
from orchestrate.store.maintenance import upgrade
from orchestrate.store.merge import merge
from orchestrate.store.sqlite import is_network, mount_of
from orchestrate.store.store import make_backend
from tests.orchestrate.store.databases import file_of
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, begin, result

SPECS = [Spec(seed) for seed in range(4)]
Change = Callable[[Path, Path], object]
DONE = "SELECT seed FROM v_trial WHERE status = 'done' ORDER BY seed"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "results"


@pytest.fixture
def url(folder: Path) -> str:
    """Return the URL of a link to a file in another folder."""
    (folder / "real").mkdir(parents=True)
    (folder / "results.db").symlink_to(folder / "real" / "file.db")
    return f"sqlite:///{folder / 'results.db'}"


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """Return another results database."""
    path = tmp_path / "other.db"
    with Store.open(f"sqlite:///{path}") as store:
        launch = store.begin_launch(LAUNCH)
        store.register(launch, [Spec(99)])
        store.end_launch(launch, "done")
    return path


def deleted(folder: Path, _: Path) -> None:
    for path in (folder / "real").glob("file.db*"):
        path.unlink() if path.is_file() else None


def renamed(folder: Path, _: Path) -> None:
    (folder / "real" / "file.db").rename(folder / "moved.db")


def replaced(folder: Path, other: Path) -> None:
    shutil.copy(other, folder / "new.db")
    (folder / "new.db").rename(folder / "real" / "file.db")


def retargeted(folder: Path, other: Path) -> None:
    (folder / "results.db").unlink()
    (folder / "results.db").symlink_to(other)


CHANGES: dict[str, Change] = {
    "deleted": deleted,
    "deleted alone": lambda folder, _: (folder / "real" / "file.db").unlink(),
    "renamed": renamed,
    "replaced": replaced,
    "retargeted": retargeted,
    "without its link": lambda folder, _: (folder / "results.db").unlink(),
    "folder renamed": lambda folder, _: (folder / "real").rename(folder / "elsewhere"),
    "without its log": lambda folder, _: (folder / "real" / "file.db-wal").unlink(),
    "without shared memory": lambda folder, _: (folder / "real" / "file.db-shm").unlink(),
}


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def saved_in(error: BaseException) -> Path:
    found = re.search(r"is saved in (\S+\.saved-\d+(-\d+)?\.db):", str(error))
    assert found, str(error)
    return Path(found[1])


def done(path: Path) -> list[int]:
    with Reader.open(f"sqlite:///{path}") as reader:
        return [row.seed for row in reader.rows(DONE)]


@pytest.mark.parametrize("name", CHANGES)
def test_what_it_holds_is_saved_and_nothing_else_is_written(
    name: str, url: str, folder: Path, other: Path
) -> None:
    with Store.open(url) as store:
        _, claims = begin(store, *SPECS)
        assert store.commit(claims[0], result(0), RUN)
        CHANGES[name](folder, other)
        before, others = content(folder), other.read_bytes()
        with pytest.raises(DatabaseMovedError, match="since it was opened") as caught:
            store.commit(claims[1], result(1), RUN)
        assert not caught.value.transient
        saved = saved_in(caught.value)
        assert done(saved) == [0, 1], "the results at hand are saved too"
        store._backend.engine.dispose()  # as after a broken connection
        with pytest.raises(DatabaseMovedError) as again:
            store.commit(claims[2], result(2), RUN)
        assert saved_in(again.value) == saved, "it is saved once"
    assert other.read_bytes() == others
    new = {path for path in {*content(folder)} - {*before} if ".saved-" not in path.name}
    assert not {path for path in new if path.suffix == ".db"}
    if name == "replaced":
        assert (folder / "real" / "file.db").read_bytes() == others
        assert done(folder / "results.db") == []
    assert store.safe_url in str(caught.value)
    assert "\n" not in str(caught.value)
    if name == "renamed":
        assert f"is now {folder / 'moved.db'}" in str(caught.value)
        with closing(sqlite3.connect(folder / "moved.db")) as moved:
            assert moved.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_a_second_launch_makes_a_new_database_that_stays_whole(url: str, folder: Path) -> None:
    with Store.open(url) as store:
        _, claims = begin(store, *SPECS)
        assert store.commit(claims[0], result(0), RUN)
        renamed(folder, folder)
        with Store.open(url) as second:
            started = second.begin_launch(LAUNCH)
            (claim, *_) = second.claim(started, second.register(started, SPECS[3:]).todo)
            assert second.commit(claim, result(3), RUN)
            with pytest.raises(DatabaseMovedError, match="replaced by another file") as caught:
                store.commit(claims[1], result(1), RUN)
            store.close()
            assert second.commit(
                second.claim(started, second.register(started, [Spec(7)]).todo)[0], result(7), RUN
            )
    assert done(saved_in(caught.value)) == [0, 1]
    assert done(folder / "moved.db") == [0, 1]
    assert done(folder / "results.db") == [3, 7]


WRITERS: dict[str, Callable[[Store, int, list[Claim]], object]] = {
    "begin": lambda store, *_: store.begin_launch(LAUNCH),
    "end": lambda store, launch, _: store.end_launch(launch, "done"),
    "heartbeat": lambda store, launch, _: store.heartbeat(launch),
    "recover": lambda store, *_: store.recover(),
    "register": lambda store, launch, _: store.register(launch, [Spec(50)]),
    "claim": lambda store, launch, _: store.claim(launch, [SPECS[3].trial_key]),
    "fail": lambda store, _, claims: store.fail(claims[0], Failure("E", "m", "t"), RUN),
    "release": lambda store, launch, _: store.release(launch),
    "retry": lambda store, *_: store.retry("all"),
    "prune": lambda store, *_: store.prune([SPECS[0].trial_key]),
    "save": lambda store, launch, _: store.save(launch, Spec(60), result(), RUN),
    "holds_more": lambda store, *_: store.holds_more(Spec(60), result()),
    "check": lambda store, *_: store.check(),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_every_writer_notices(writer: str, url: str, folder: Path, other: Path) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        claims = store.claim(launch, store.register(launch, SPECS).todo[:3])
        replaced(folder, other)
        with pytest.raises(DatabaseMovedError, match="replaced by another file"):
            WRITERS[writer](store, launch, claims)
    assert file_of(url).read_bytes() == other.read_bytes()


@pytest.mark.parametrize("command", ["merge", "upgrade"])
def test_a_command_notices(
    command: str, url: str, folder: Path, other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store.open(url).close()
    kept = other.read_bytes()
    remember = sqlite.SQLiteBackend._remember
    calls = {"merge": 2, "upgrade": 1}

    def lost(backend: sqlite.SQLiteBackend) -> None:
        remember(backend)
        calls[command] -= 1
        if not calls[command]:
            replaced(folder, other)

    monkeypatch.setattr(sqlite.SQLiteBackend, "_remember", lost)
    commands: dict[str, Callable[[], object]] = {
        "merge": lambda: merge(url, f"sqlite:///{other}"),
        "upgrade": lambda: upgrade(url, backup=False),
    }
    with pytest.raises(DatabaseMovedError, match="replaced by another file"):
        commands[command]()
    assert file_of(url).read_bytes() == kept


def test_without_room_beside_it_the_temporary_folder_is_used_and_without_that_it_is_said(
    url: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "temporary"))
    for there in (True, False):
        if there:
            (tmp_path / "temporary").mkdir()
        with Store.open(url) as store:
            store.begin_launch(LAUNCH)
            shutil.rmtree(folder)
            with pytest.raises(DatabaseMovedError) as caught:
                store.recover()
        if there:
            assert saved_in(caught.value).parent == tmp_path / "temporary"
            shutil.rmtree(tmp_path / "temporary")
            (folder / "real").mkdir(parents=True)
        else:
            assert "cannot be saved beside it or in the temporary folder (" in str(caught.value)


def test_a_log_of_a_removed_file_is_no_log_of_a_new_one(url: str, folder: Path) -> None:
    with Store.open(url) as store:
        store.begin_launch(LAUNCH)
        log = (folder / "real" / "file.db-wal").read_bytes()
        assert log
    deleted(folder, folder)
    (folder / "real" / "file.db-wal").write_bytes(log)
    with Store.open(url) as store:
        assert store.begin_launch(LAUNCH) == 1


ROOT = "29 1 259:2 / / rw,relatime shared:1 - ext4 /dev/nvme0n1p2 rw,errors=remount-ro\n"
TABLES = {
    "home on NFS": (
        ROOT + "412 29 0:52 / /home rw,relatime shared:220 - nfs4 nas:/export/home rw,vers=4.2,"
        "rsize=1048576,hard,proto=tcp,sec=sys,local_lock=none,addr=10.0.0.5\n",
        "/home/ada/results/results.db",
        ("/home", "nfs4"),
    ),
    "a share of Windows with a space in its name": (
        ROOT + r"301 29 0:71 / /mnt/lab\040data rw,relatime shared:150 - cifs //filer/lab rw,"
        "vers=3.1.1,cache=strict,username=ada\n",
        "/mnt/lab data/results.db",
        ("/mnt/lab data", "cifs"),
    ),
    "a local disk mounted below a home on NFS": (
        ROOT + "412 29 0:52 / /home rw - nfs nas:/export/home rw,vers=3,nolock\n"
        "413 412 8:17 / /home/ada/local rw - ext4 /dev/sdb1 rw\n",
        "/home/ada/local/results.db",
        ("/home/ada/local", "ext4"),
    ),
    "a container with a volume": (
        "1042 983 0:212 / / rw,relatime master:420 - overlay overlay rw,lowerdir=/var/lib/docker\n"
        "1043 1042 0:215 / /proc rw,nosuid,nodev,noexec,relatime - proc proc rw\n"
        "1050 1042 259:2 /docker/volumes/v/_data /app/results rw - ext4 /dev/nvme0n1p2 rw\n",
        "/app/results/results.db",
        ("/app/results", "ext4"),
    ),
    "a mount that hides an earlier one": (
        ROOT + "60 29 0:50 / /data rw - ext4 /dev/sdb1 rw\n61 60 0:51 / /data rw - nfs4 n:/d rw\n",
        "/data/results.db",
        ("/data", "nfs4"),
    ),
    "a folder whose name begins as the name of a mount": (
        ROOT + "60 29 0:50 / /data rw - nfs4 nas:/data rw\n",
        "/database/results.db",
        ("/", "ext4"),
    ),
}
LOCAL = {"ext4", "xfs", "btrfs", "zfs", "overlay", "tmpfs", "fuseblk", "fuse.mergerfs", "ntfs3"}
SHARED = {
    *("nfs", "nfs4", "cifs", "smb3", "9p", "ceph", "fuse.sshfs", "fuse.glusterfs"),
    *("lustre", "gpfs", "beegfs"),
    *("virtiofs", "vboxsf", "prl_fs", "drvfs", "fakeowner"),  # a virtual machine and its host
    *("vmhgfs", "fuse.vmhgfs-fuse", "fuse.grpcfuse", "fuse.osxfs", "fuse", "lxfs", "unheard_of"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_judged(name: str) -> None:
    table, path, (folder, kind) = TABLES[name]
    assert mount_of(PurePosixPath(path), table) == (PurePosixPath(folder), kind)
    assert is_network(kind) == (kind not in LOCAL)


@pytest.mark.parametrize("kind", sorted(SHARED | LOCAL))
def test_what_is_not_known_to_be_safe_is_refused_unless_the_user_says_that_it_is(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_network(kind) == (kind in SHARED)
    monkeypatch.setenv("DOPT_SAFE_FILE_SYSTEMS", f"other, {kind}")
    assert not is_network(kind)
    monkeypatch.setenv("DOPT_SAFE_FILE_SYSTEMS", f"{kind}x")
    assert is_network(kind) == (kind in SHARED)


def test_a_database_on_a_network_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "mountinfo"
    table.write_text(f"{ROOT}60 29 0:50 / {tmp_path}/home rw - nfs4 nas:/home rw\n")
    monkeypatch.setattr(sqlite, "MOUNT_TABLE", table)
    (tmp_path / "link").symlink_to(tmp_path / "home", target_is_directory=True)
    url = make_url(f"sqlite:///{tmp_path}/link/results/results.db")
    with pytest.raises(StoreError, match=r"home, whose file system \(nfs4\).*store=postgresql"):
        make_backend(url)
    assert not (tmp_path / "home").exists()
    make_backend(make_url(f"sqlite:///{tmp_path}/local/results.db")).close()


def test_nothing_is_refused_where_there_is_no_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite, "MOUNT_TABLE", tmp_path / "none")
    make_backend(make_url(f"sqlite:///{tmp_path}/results.db")).close()
