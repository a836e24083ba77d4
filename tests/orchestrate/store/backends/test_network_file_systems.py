"""File systems where SQLite is not safe: found from the table of mounts, and refused at first."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest
from sqlalchemy import make_url

from orchestrate.store.backends import network_file_systems
from orchestrate.store.backends.network_file_systems import is_network, mount_of
from orchestrate.store.backends.open import make_backend
from orchestrate.store.errors import StoreError

ROOT = "29 1 259:2 / / rw,relatime shared:1 - ext4 /dev/nvme0n1p2 rw,errors=remount-ro\n"
TABLES = {
    "home on NFS": (
        ROOT + "412 29 0:52 / /home rw,relatime shared:220 - nfs4 nas:/export/home rw,vers=4.2,"
        "rsize=1048576,hard,proto=tcp,sec=sys,local_lock=none,addr=10.0.0.5\n",
        "/home/ada/results/results.db",
        ("/home", "nfs4"),
    ),
    "scratch on Lustre, home on local disks": (
        "24 1 253:0 / / rw,relatime shared:1 - xfs /dev/mapper/rl-root rw,attr2,inode64\n"
        "97 24 253:2 / /home rw,relatime shared:52 - xfs /dev/mapper/rl-home rw,attr2,inode64\n"
        "139 24 0:57 / /lustre/scratch rw,relatime shared:70 - lustre 10.1.0.1@o2ib:/scratch rw\n",
        "/lustre/scratch/ada/results.db",
        ("/lustre/scratch", "lustre"),
    ),
    "GPFS": (
        ROOT + "188 29 0:61 / /gpfs/fs1 rw,relatime shared:88 - gpfs fs1 rw,maxblocksize=16384k\n",
        "/gpfs/fs1/group/results.db",
        ("/gpfs/fs1", "gpfs"),
    ),
    "a share of Windows with a space in its name": (
        ROOT + r"301 29 0:71 / /mnt/lab\040data rw,relatime shared:150 - cifs //filer/lab rw,"
        "vers=3.1.1,cache=strict,username=ada\n",
        "/mnt/lab data/results.db",
        ("/mnt/lab data", "cifs"),
    ),
    "BeeGFS": (
        ROOT + "150 29 0:55 / /mnt/beegfs rw,relatime - beegfs beegfs_nodev rw,cfgFile=/etc/b\n",
        "/mnt/beegfs/results.db",
        ("/mnt/beegfs", "beegfs"),
    ),
    "a folder of another machine by ssh": (
        ROOT + "55 29 0:24 / /sys/fs/fuse/connections rw - fusectl fusectl rw\n"
        "420 29 0:60 / /home/ada/remote rw,nosuid,nodev - fuse.sshfs ada@hpc: rw,user_id=1000\n",
        "/home/ada/remote/runs/results.db",
        ("/home/ada/remote", "fuse.sshfs"),
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
    "a folder whose name begins as that of a mount": (
        ROOT + "60 29 0:50 / /data rw - nfs4 nas:/data rw\n",
        "/database/results.db",
        ("/", "ext4"),
    ),
}
LOCAL = {"ext4", "xfs", "btrfs", "zfs", "overlay", "tmpfs", "fuseblk", "fuse.mergerfs", "ntfs3"}
SHARED = {
    *("nfs", "nfs4", "cifs", "smb3", "9p", "ceph", "fuse.sshfs", "fuse.glusterfs"),
    *("virtiofs", "vboxsf", "prl_fs", "drvfs", "fakeowner"),  # a virtual machine and its host
    *("vmhgfs", "fuse.vmhgfs-fuse", "fuse.grpcfuse", "fuse.osxfs", "fuse", "lxfs", "unheard_of"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_judged(name: str) -> None:
    table, path, (folder, kind) = TABLES[name]
    assert mount_of(PurePosixPath(path), table) == (PurePosixPath(folder), kind)
    assert is_network(kind) == (kind not in LOCAL)


@pytest.mark.parametrize("kind", sorted(LOCAL))
def test_what_disks_of_this_machine_hold_is_no_network(kind: str) -> None:
    assert not is_network(kind)


@pytest.mark.parametrize("kind", sorted(SHARED))
def test_what_is_not_known_to_be_safe_is_refused_unless_the_user_says_that_it_is(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_network(kind)
    monkeypatch.setenv("DOPT_SAFE_FILE_SYSTEMS", f"other, {kind}")
    assert not is_network(kind)
    monkeypatch.setenv("DOPT_SAFE_FILE_SYSTEMS", f"{kind}x")
    assert is_network(kind)


def test_a_database_on_a_network_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "mountinfo"
    table.write_text(f"{ROOT}60 29 0:50 / {tmp_path}/home rw - nfs4 nas:/home rw\n")
    monkeypatch.setattr(network_file_systems, "MOUNT_TABLE", table)
    (tmp_path / "link").symlink_to(tmp_path / "home", target_is_directory=True)
    url = make_url(f"sqlite:///{tmp_path}/link/results/results.db")
    with pytest.raises(StoreError, match=r"home, whose file system \(nfs4\).*store=postgresql"):
        make_backend(url)
    assert not (tmp_path / "home").exists()
    make_backend(make_url(f"sqlite:///{tmp_path}/local/results.db")).close()


def test_nothing_is_refused_where_there_is_no_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_file_systems, "MOUNT_TABLE", tmp_path / "none")
    make_backend(make_url(f"sqlite:///{tmp_path}/results.db")).close()
