"""File systems on which SQLite is known to be safe; others can lose or damage what is written.

The write-ahead log is shared memory, which one machine, or a virtual one and its host, cannot share
with another (https://www.sqlite.org/wal.html), and the locks of many such file systems fail.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from orchestrate.store.errors import StoreError

MOUNT_TABLE = Path("/proc/self/mountinfo")

SAFE_VARIABLE = "DOPT_SAFE_FILE_SYSTEMS"
"""Environment variable with further kinds of file systems that its user knows to be safe."""

_SAFE = frozenset(
    {
        *("ext2", "ext3", "ext4", "xfs", "btrfs", "zfs", "bcachefs", "f2fs", "jfs", "nilfs2"),
        *("reiserfs", "ufs", "apfs", "hfs", "hfsplus", "ubifs", "simfs"),
        *("vfat", "msdos", "exfat", "ntfs", "ntfs3", "fuseblk", "udf", "iso9660", "squashfs"),
        *("tmpfs", "ramfs", "devtmpfs", "rootfs", "overlay", "overlayfs", "aufs", "ecryptfs"),
    }
)
"""File systems of disks and memory of this machine, and layers over them."""

_LOCAL_PROGRAMS = frozenset(
    {"mergerfs", "fuse-overlayfs", "bindfs", "ntfs-3g", "exfat", "gocryptfs", "encfs", "cryfs"}
)
"""Programs that serve a file system by FUSE from disks of this machine."""


class Mount(NamedTuple):
    """Mounted file system."""

    folder: PurePosixPath
    kind: str  # such as ext4, or fuse.sshfs


def refuse_unsafe(path: Path, safe_url: str) -> None:
    """Raise ``StoreError`` if the file of a database would be where SQLite is not known to be safe.

    ``path`` is absolute, and neither it nor its folder has to exist. Where the system has no table
    of mounts, nothing is refused.
    """
    try:
        table = MOUNT_TABLE.read_text(errors="surrogateescape")
    except OSError:
        return
    mount = mount_of(PurePosixPath(path), table)
    if mount is not None and is_network(mount.kind):
        raise StoreError(
            f"The results database {safe_url} would be on {mount.folder}, whose file system "
            f"({mount.kind}) is not known to keep the log and the locks of SQLite whole, so that "
            "results can be lost or damaged, but a disk of this machine is expected: give a file "
            "on one, such as store.url=sqlite:////var/tmp/results.db (in a container a volume, in "
            "WSL a folder of Linux), and copy it afterwards, use PostgreSQL (store=postgresql), "
            "which many machines share, or let each machine write a share of the grid to its own "
            f"disk (store=shards). If you know that it is safe, set {SAFE_VARIABLE}={mount.kind}."
        )


def mount_of(path: PurePosixPath, table: str) -> Mount | None:
    """Return the file system that holds an absolute path, given the text of ``mountinfo``.

    It is the innermost one; of several at the same folder, the last one hides the others.
    """
    holding = None
    for line in table.splitlines():
        before, found, after = line.partition(" - ")
        if not found:
            continue
        mount = Mount(PurePosixPath(_unescaped(before.split(" ")[4])), after.split(" ")[0])
        if path.is_relative_to(mount.folder) and (
            holding is None or len(mount.folder.parts) >= len(holding.folder.parts)
        ):
            holding = mount
    return holding


def is_network(kind: str) -> bool:
    """Return whether a kind of file system is taken for one that several machines share.

    Every kind is that is not known to be safe, and that ``DOPT_SAFE_FILE_SYSTEMS`` does not name.
    """
    system, _, program = kind.partition(".")
    safe = program in _LOCAL_PROGRAMS if system == "fuse" else kind in _SAFE
    return not safe and kind not in re.split(r"[,\s]+", os.environ.get(SAFE_VARIABLE, ""))


def _unescaped(field: str) -> str:
    r"""Return a field of the table with its octal codes, such as \040, as characters."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), field)
