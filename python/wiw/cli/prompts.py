# SPDX-License-Identifier: Apache-2.0
"""`wiw prompts`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def import_prompts(
    source: Positional[Annotated[Path, arg(metavar="SOURCE")]],
    /,
    *,
    out: Annotated[Path, arg(metavar="DIR")],
) -> int:
    r"""Write a folder of prompts from your own copy of the paper.

    $ wiw prompts import paper/main.tex --out prompts/paper
    $ wiw prompts import world-in-world --out prompts/published
    $ wiw run ar --policy vlm --world-model warp --prompts prompts/paper

    Slots are mapped to those of wiw, and each prompt is test-rendered. The output format, and questions for which the
    source has no prompt, come from the set `minimal` (`wiw list prompts`). prompts.yaml in the folder says where each
    template came from; runs record the digest of all of them.

    Args:
        source: The paper's LaTeX source (a file or a folder), or a checkout of its published code.
        out: Folder to write, new or empty.
    """
    from wiw.policies.vlm.prompt_import.importer import import_prompts

    done = import_prompts(source, out)
    for name, place in done.imported.items():
        print(f"{name:<30}{place}")
    for name, origin in done.completed.items():
        print(f"{name:<30}shipped set {origin}")
    for name in done.unused:
        print(f"not used: {name}")
    print(f"\ndigest  {done.digest}\nprompts {done.folder}\nuse     --prompts {done.folder}")
    return 0
