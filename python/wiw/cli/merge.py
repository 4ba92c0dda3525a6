# SPDX-License-Identifier: Apache-2.0
"""`wiw merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def merge(
    stores: Positional[Annotated[tuple[Path, ...], arg(metavar="STORE [STORE ...]", help_behavior_hint="(required)")]],
    /,
    *,
    out: Annotated[Path, arg(metavar="RUN")],
    scratch: Annotated[Path | None, arg(metavar="DIR")] = None,
) -> int:
    """Merge the stores of a run's shards into one run, identical to what a single process would have recorded.

    $ wiw merge runs/a/1 runs/a/2 --out runs/whole
    $ wiw merge runs/a --out runs/whole
    $ wiw report runs/whole

    Stores of different runs are refused, naming the first difference. An episode found in several stores is taken from
    the first that has finished it; differing records are refused if equal ones are guaranteed, and counted otherwise.
    Episodes that no store has are listed, and `wiw resume` runs them. A run at --out that was merged from the same
    shards is replaced, unless it was resumed or judged since. See docs/many-machines.md.

    Args:
        stores: Folders of runs with --shard, or folders that contain them.
        out: Folder of the merged run, on any disk.
        scratch: Folder on a local disk in which it is written first. Default: the system's temporary folder.
    """
    from wiw.runs.merge import merge as merge_stores

    print(merge_stores(stores, out, scratch))
    return 0
