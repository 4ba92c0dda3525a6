# SPDX-License-Identifier: Apache-2.0
"""Tell network file systems from local disks: SQLite's log is safe on a local disk alone.

The log in WAL mode is shared through memory that processes map, which other machines do not see
(https://www.sqlite.org/wal.html); locks of network file systems are unreliable besides.
"""

from __future__ import annotations

import re
from pathlib import Path

MOUNTS = Path("/proc/self/mountinfo")
"""Mounted file systems, as Linux lists them; see proc(5)."""
NETWORK = frozenset(
    (
        *("afs", "beegfs", "ceph", "cifs", "davfs", "fhgfs", "glusterfs", "gpfs", "lustre", "ncpfs", "nfs", "nfs4"),
        *("ocfs2", "orangefs", "panfs", "pvfs2", "smb3", "smbfs", "wekafs"),
        *("fuse.beegfs", "fuse.ceph", "fuse.ceph-fuse", "fuse.gcsfuse", "fuse.glusterfs", "fuse.goofys"),
        *("fuse.juicefs", "fuse.mount-s3", "fuse.rclone", "fuse.s3fs", "fuse.sshfs"),
    )
)
"""Types of file systems that several machines may write."""


def find_network(path: Path) -> str | None:
    """Return the type of the network file system that a path is or would be on, such as "nfs4"; None on a local disk.

    Where the system has no list of mounts, every path counts as local.
    """
    try:
        lines = MOUNTS.read_text().splitlines()
    except OSError:
        return None
    place, found, depth = path.expanduser().resolve(), None, -1
    for line in lines:
        before, _, after = line.partition(" - ")
        mount = Path(_unescape(before.split()[4]))
        if place.is_relative_to(mount) and len(mount.parts) >= depth:  # of two at one place the later one is on top
            found, depth = after.split()[0], len(mount.parts)
    return found if found in NETWORK else None


def choose_journal_mode(path: Path) -> str:
    """Return the journal mode for an SQLite file of many writers at a path: WAL is safe on a local disk alone."""
    return "DELETE" if find_network(path) else "WAL"


def _unescape(text: str) -> str:
    r"""Return a path of the list of mounts, which has a space as \040."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code.group(1), 8)), text)
