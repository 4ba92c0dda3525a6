# SPDX-License-Identifier: Apache-2.0
"""`wiw doctor`."""

from __future__ import annotations

import importlib.util
import os
import platform
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    detail: str
    remedy: str = ""
    """The remedy; empty if nothing is wrong."""


def doctor() -> int:
    """Report what this machine can do, line by line, and how to fix what is missing.

    $ wiw doctor
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    for column in range(3):
        table.add_column(no_wrap=column < 2)
    findings = list(examine())
    for finding in findings:
        mark = "[yellow]WARN[/]" if finding.remedy else "[green]OK[/]"
        detail = escape(finding.detail) + (f"\n[yellow]{escape(finding.remedy)}[/]" if finding.remedy else "")
        table.add_row(mark, f"[bold]{finding.name}[/]", detail)
    Console(highlight=False).print(table)
    return 0


def examine() -> Iterator[Finding]:
    """Return all findings, in the order in which they are shown."""
    yield from _check_software()
    yield from _check_processor()
    yield _check_memory()
    yield from _check_rendering()
    yield _check_torch()
    yield _check_writable("runs folder", Path.cwd())
    yield _cache()
    yield _check_writable("temporary files", Path(tempfile.gettempdir()))


def _check_software() -> Iterator[Finding]:
    import wiw
    from wiw.runs.platform import find_version

    yield Finding("wiw", f"{wiw.__version__} in {Path(wiw.__file__).parent}")
    old = tuple(map(int, platform.python_version_tuple()[:2])) < (3, 10)
    yield Finding("python", platform.python_version(), "wiw needs Python 3.10 or newer" if old else "")
    names = ("numpy", "scipy", "opencv-python-headless", "gymnasium", "matplotlib", "jinja2", "rich", "tyro")
    missing = [name for name in names if not find_version(name)]
    remedy = f"pip install {' '.join(missing)}" if missing else ""
    yield Finding("packages", ", ".join(f"{name} {find_version(name) or 'missing'}" for name in names), remedy)


def _check_processor() -> Iterator[Finding]:
    from wiw._core import core
    from wiw.runs.platform import processor_name

    cores, threads = len(os.sched_getaffinity(0)), core.num_threads()
    yield Finding("processor", f"{processor_name()}, {cores} cores")
    fewer = f"WIW_NUM_THREADS leaves {cores - threads} cores idle; unset it" if threads < cores else ""
    yield Finding("threads", str(threads), fewer)
    isa, native = core.active_isa(), core.native_isa()
    slow = "" if isa == native else f"WIW_ISA holds it below {native}; unset it"
    slow = slow or ("kernels run without AVX2, which makes them several times slower" if isa == "scalar" else "")
    yield Finding("instructions", isa, slow)


def _check_memory() -> Finding:
    facts = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    total, free = (int(facts[name].split()[0]) / 2**20 for name in ("MemTotal", "MemAvailable"))
    remedy = "a worker needs about 1 GB: use --workers 1 and close other programs" if free < 2 else ""
    return Finding("memory", f"{free:.1f} of {total:.1f} GB free", remedy)


def _check_rendering() -> Iterator[Finding]:
    from wiw._core import render
    from wiw.errors import BackendError

    yield Finding("cpu renderer", "always available")
    try:
        devices = render.egl_devices()
    except BackendError as error:
        yield Finding(
            "gpu renderer", f"no EGL: {error}", "only needed for --backend gpu: apt-get install libegl1 libegl-mesa0"
        )
        return
    usable = [device for device in devices if not device["error"]]
    for device in devices:
        kind = "software" if device["software"] else "hardware"
        what = device["error"] or f"{device['renderer']}, OpenGL {device['version']} ({kind})"
        yield Finding(
            f"egl device {device['index']}", what, "this device provides no OpenGL context" if device["error"] else ""
        )
    if not usable:
        yield Finding(
            "gpu renderer", "no usable EGL device", "only needed for --backend gpu: install a driver or libegl-mesa0"
        )


def _check_torch() -> Finding:
    """Return whether torch is installed, without importing it, which takes seconds."""
    from wiw.runs.platform import find_version

    if importlib.util.find_spec("torch") is None:
        return Finding("torch", "not installed; only learned world models need it (pip install 'wiw[torch]')")
    return Finding("torch", find_version("torch") or "of unknown version")


def _check_writable(name: str, folder: Path) -> Finding:
    gigabytes = _count_free_gigabytes(folder)
    detail = f"{folder}, {gigabytes:.0f} GB free"
    if not os.access(folder, os.W_OK):
        return Finding(name, detail, "not writable: change to another folder or give --out")
    return Finding(name, detail, "nearly full: a run with pictures may need 1 GB" if gigabytes < 1 else "")


def _cache() -> Finding:
    """Describe the cache of imported and generated scenes: where it is, what it holds, whether it can grow."""
    from wiw.scenes.store import folder, limit

    cache = folder()
    files = [path.stat() for path in cache.glob("*")] if cache.is_dir() else []
    there = next(path for path in (cache, *cache.parents) if path.exists())
    used, free = sum(file.st_size for file in files) / 2**20, _count_free_gigabytes(there)
    remedy = "nearly full: delete the folder, or set WIW_CACHE to another" if free < 1 else ""
    if not os.access(there, os.W_OK):
        remedy = f"{there} is not writable: set WIW_CACHE to another folder"
    most = f"at most {limit() / 2**30:g} GB (WIW_CACHE_GB)"
    detail = f"{cache}, {len(files)} files, {used:.0f} MB, {most}, {free:.0f} GB free"
    return Finding("scene cache", detail, remedy)


def _count_free_gigabytes(folder: Path) -> float:
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize / 2**30
