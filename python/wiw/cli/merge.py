# SPDX-License-Identifier: Apache-2.0
"""`wiw merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def merge(
    stores: Positional[Annotated[tuple[Path, ...], arg(metavar="STORE [STORE ...]")]],
    /,
    *,
    out: Annotated[Path, arg(metavar="RUN")],
    scratch: Annotated[Path | None, arg(metavar="DIR")] = None,
) -> int:
    """Merge the stores of a run's shards into one run, equal to what one process would have recorded.

    $ wiw merge runs/a/1 runs/a/2 --out runs/whole
    $ wiw merge runs/a --out runs/whole
    $ wiw report runs/whole

    Stores of unlike runs are refused, with the first difference. An episode that several stores have is taken from the
    first that has ended it; records that differ are refused where equal ones are promised, and counted elsewhere.
    Episodes that no store has are named, and `wiw resume` runs them. docs/many-machines.md has the whole.

    Args:
        stores: Folders of runs with --shard, or folders that hold these.
        out: Folder of the merged run; any disk will do.
        scratch: Folder on a local disk in which it is written first; the system's for temporary files if not given.
    """
    from wiw.runs.merge import merge as merge_stores

    print(merge_stores(stores, out, scratch))
    return 0
