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
        *("afs", "beegfs", "ceph", "cifs", "coda", "cvfs", "cxfs", "davfs", "dvs", "fhgfs", "gfs", "gfs2"),
        *("glusterfs", "gpfs", "lizardfs", "lustre", "mfs", "mmfs", "ncpfs", "nfs", "nfs4", "ocfs2", "orangefs"),
        *("panfs", "pvfs2", "quobyte", "smb3", "smbfs", "wekafs"),
        *("fuse.alluxio-fuse", "fuse.beegfs", "fuse.blobfuse2", "fuse.ceph", "fuse.ceph-fuse", "fuse.daos"),
        *("fuse.dfuse", "fuse.gcsfuse", "fuse.glusterfs", "fuse.goofys", "fuse.juicefs", "fuse.lizardfs"),
        *("fuse.mfs", "fuse.mfsmount", "fuse.moosefs", "fuse.mount-s3", "fuse.quobyte", "fuse.rclone", "fuse.s3fs"),
        *("fuse.seaweedfs", "fuse.sshfs"),
    )
)
"""Types of file systems that several machines may write."""
HOST = frozenset(("9p", "drvfs", "fakeowner", "prl_fs", "vboxsf", "virtiofs", "vmhgfs"))
"""Types of folders that a virtual machine or container shares with its host, such as /mnt/c in WSL2."""
LOCAL_FUSE = frozenset(("fuse.fuse-overlayfs", "fuse.fuse2fs", "fuse.squashfuse", "fuse.squashfuse_ll"))
"""Types of file systems in user space that lie on this machine's disks: those that containers are made of."""


def find_network(path: Path) -> str | None:
    """Return the type of the network file system that a path is or would be on, such as "nfs4"; None on a local disk.

    A file system in user space is taken for one unless it is known to be local, for any program can offer a remote
    disk in this way; and so is a folder of the host of a virtual machine, which does not see what the machine maps in
    memory. Neither is where it holds the root folder, which is then the machine's or the container's own.

    Where the system has no list of mounts, every path counts as local.
    """
    place = path.expanduser().resolve()  # first: this mounts what is mounted when it is asked for
    try:
        lines = MOUNTS.read_text().splitlines()
    except OSError:
        return None
    kind, holder = "", Path()
    for line in lines:
        before, _, after = line.partition(" - ")
        mount = Path(_unescape(before.split()[4]))
        if place.is_relative_to(mount) and len(mount.parts) >= len(holder.parts):  # the later of two is on top
            kind, holder = after.split()[0], mount
    if kind in NETWORK:
        return kind
    is_shared = kind in HOST or (_is_in_user_space(kind) and kind not in LOCAL_FUSE)
    return f"{kind}, taken for one" if is_shared and holder != Path("/") else None


def _is_in_user_space(kind: str) -> bool:
    """Return whether a type is FUSE's; "fuseblk" is one of a local disk."""
    return kind == "fuse" or kind.startswith("fuse.")


def choose_journal_mode(path: Path) -> str:
    """Return the journal mode for an SQLite file of many writers at a path: WAL is safe on a local disk alone."""
    return "DELETE" if find_network(path) else "WAL"


def _unescape(text: str) -> str:
    r"""Return a path of the list of mounts, which has a space as \040."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code.group(1), 8)), text)
