# SPDX-License-Identifier: Apache-2.0
"""`wiw bench gpu`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

if TYPE_CHECKING:
    from wiw.studies.device_benchmark import DeviceBenchmark


def bench_gpu(
    *,
    scene: Annotated[str, arg(metavar="SPEC")] = "apartments:val/0",
    networks: Annotated[str, arg(metavar="all|none|A,B,...")] = "all",
    rendering: bool = True,
    seconds: Annotated[float, arg(metavar="SECONDS")] = 0.5,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
) -> int:
    """Measure this machine's GPU: batched rendering, rollouts and training steps of the small networks, memory.

    $ wiw bench gpu --out gpu.json
    $ wiw bench gpu --networks warpnet,pocket --no-rendering

    Views are rendered with EGL on the first hardware device, 1, 16, 64 and 256 at a time, and networks run in torch on
    CUDA with batches of 1, 16 and 64. On a machine without a GPU the command runs small versions of what it can, and
    says what was skipped. Times are medians of wall-clock time, so leave the machine idle otherwise.

    Args:
        scene: The scene to render, as the spec of a single scene.
        networks: Some of warpnet, armnet, navigator, recogniser, perception, pocket, diffuser.
        rendering: Whether to measure rendering.
        seconds: Seconds to spend on each measurement.
        out: JSON file for all measurements, the device's name and the platform.
    """
    from wiw.cli.bars import Bars
    from wiw.studies.device_benchmark import benchmark_device

    names = {"all": None, "none": []}.get(networks, [name.strip() for name in networks.split(",") if name.strip()])
    done = 0
    with Bars() as bars:

        def show(what: str) -> None:
            nonlocal done
            done += 1
            bars.show("measuring", done, done + 1, what)

        found = benchmark_device(scene, networks=names, rendering=rendering, seconds=seconds, progress=show)
    _print(found)
    if out is not None:
        print(f"written  {found.save(out)}")
    return 0


def _print(found: DeviceBenchmark) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    for kind, name in found.devices.items():
        console.print(f"{kind:9}{name}", markup=False, soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for column in ("what", "device", "batch", "ms a batch", "ms each", "memory"):
        table.add_column(column, no_wrap=True, justify="left" if column in ("what", "device") else "right")
    for row in found.rows:
        memory = "" if row.memory_mb is None else f"{row.memory_mb:.0f} MB"
        each = f"{row.ms_each:.2f} / {row.unit}"
        kind = next(kind for kind, name in found.devices.items() if name == row.device)
        table.add_row(row.what, kind, str(row.batch), f"{row.ms:.1f}", escape(each), memory)
    console.print(table)
    for line in found.not_run:
        console.print(f"not run  {line}", markup=False, soft_wrap=True)
    for note in found.notes:
        console.print(note, markup=False, soft_wrap=True)
