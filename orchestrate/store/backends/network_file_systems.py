"""File systems of several machines, on which SQLite loses what two of them write at once.

The write-ahead log is shared memory, which one machine cannot share with another
(https://www.sqlite.org/wal.html), and the locks of many of these file systems fail.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from orchestrate.store.errors import StoreError

MOUNT_TABLE = Path("/proc/self/mountinfo")

_NETWORK = frozenset(
    {
        *("nfs", "nfs4", "cifs", "smb3", "smbfs", "afs", "9p"),
        *("lustre", "gpfs", "beegfs", "ceph", "glusterfs", "gfs2", "ocfs2", "orangefs", "pvfs2"),
        *("panfs", "wekafs"),
    }
)
_LOCAL_PROGRAMS = frozenset(
    {"mergerfs", "fuse-overlayfs", "bindfs", "ntfs-3g", "exfat", "gocryptfs", "encfs", "cryfs"}
)
"""Programs that serve a file system by FUSE from disks of this machine."""


class Mount(NamedTuple):
    """Mounted file system."""

    folder: PurePosixPath
    kind: str  # such as ext4, or fuse.sshfs


def refuse_network(path: Path, safe_url: str) -> None:
    """Raise ``StoreError`` if the file of a database would be on a network file system.

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
            f"The results database {safe_url} would be on {mount.folder}, a network file system "
            f"({mount.kind}), on which SQLite can lose results, but a disk of this machine is "
            "expected: give a file on one, such as store.url=sqlite:////var/tmp/results.db, and "
            "copy it afterwards, use PostgreSQL (store=postgresql), which many machines share, or "
            "let each machine write a share of the grid to its own disk (store=shards)."
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
    """Tell whether a kind of file system can be shared by machines.

    A program that serves files by FUSE is taken for one of a network unless it is known not to be.
    """
    system, _, program = kind.partition(".")
    if system == "fuse":
        return program not in _LOCAL_PROGRAMS
    return system in _NETWORK


def _unescaped(field: str) -> str:
    r"""Return a field of the table with its octal codes, such as \040, as characters."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), field)
