# SPDX-License-Identifier: Apache-2.0
"""Benchmark a machine's GPU: batched rendering, and rollouts and training steps of the small networks.

One call measures everything, so that results of different machines are comparable. On a machine without a GPU the same
call measures small versions of what can run, and says what was skipped.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import wiw
from wiw._core import render
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError, BackendError, Error
from wiw.files import atomic_file
from wiw.runs.platform import describe_platform

VIEWS = (1, 16, 64, 256)
"""Views per batch on a GPU."""
ROWS = (1, 16, 64)
"""Rows per network batch on a GPU."""
FEW_VIEWS, FEW_ROWS = (1, 4), (1, 2)
"""The same on a machine without a GPU."""
SIZES: dict[str, tuple[int, int]] = {"perspective": (480, 480), "panorama": (576, 1024)}
"""Height and width of views."""
SHRINK = 4
"""Factor by which views are smaller on a machine without a GPU."""
SECONDS, LEAST, MOST = 0.5, 3, 50
"""Seconds spent on each measurement, and the minimum and maximum number of repeats."""
LEARNING_RATE = 1e-5
Backend = Literal["cpu", "gpu"]
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Measurement:
    """One figure."""

    what: str
    """"perspective 480x480", "warpnet rollout", ..."""
    device: str
    batch: int
    unit: str
    """One of the batch."""
    ms: float
    """Time of a batch: the median over the repeats."""
    memory_mb: float | None
    """Peak device memory used by torch in megabytes; None if unknown."""

    @property
    def ms_each(self) -> float:
        """Milliseconds per item of the batch."""
        return self.ms / self.batch


@dataclass(frozen=True)
class DeviceBenchmark:
    """The result of `wiw.benchmark_device`."""

    devices: dict[str, str]
    """Names of the devices found: "cpu", and "cuda" and "egl" if available."""
    platform: dict[str, Any]
    rows: list[Measurement]
    not_run: list[str]
    """Skipped measurements, with the reason."""
    notes: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        """Return all measurements as JSON."""
        rows = [{**asdict(row), "ms_each": row.ms_each} for row in self.rows]
        return json.dumps({**asdict(self), "wiw": wiw.__version__, "rows": rows}, indent=1)

    def save(self, path: str | Path) -> Path:
        """Write the measurements as JSON.

        Raises:
            FileError: the file cannot be written.
        """
        path = Path(path).expanduser()
        with atomic_file(path) as draft:
            draft.write_text(self.to_json() + "\n")
        return path


def benchmark_device(
    scene: str = "apartments:val/0",
    *,
    networks: Sequence[str] | None = None,
    rendering: bool = True,
    views: Sequence[int] | None = None,
    rows: Sequence[int] | None = None,
    seconds: float = SECONDS,
    progress: Progress = lambda _: None,
) -> DeviceBenchmark:
    """Measure batched rendering, and rollouts and training steps of the small networks, on this machine's devices.

        found = wiw.benchmark_device()
        found.save("gpu.json")

    With a GPU: with EGL on the first hardware device, and with torch on "cuda". Without one: on the CPU, in small
    sizes.

    Args:
        scene: spec of the single scene to render.
        networks: names, such as "warpnet"; all if None, none if empty.
        rendering: whether to measure rendering.
        views: views per batch; by default 1, 16, 64 and 256 on a GPU, otherwise 1 and 4.
        rows: rows per network batch; by default 1, 16 and 64 on a GPU, otherwise 1 and 2.
        seconds: seconds to spend on each measurement, apart from the minimum number of repeats.
        progress: called with a description before each measurement.

    Raises:
        ArgumentError: an unknown network, a number below 1, or seconds below 0.
        FileError: there is no such scene.
    """
    for name, numbers in (("views", views), ("rows", rows)):
        if numbers is not None and (not numbers or min(numbers) < 1):
            raise ArgumentError(f"bench: expected {name} of at least 1, got {list(numbers)}")
    if not seconds >= 0:
        raise ArgumentError(f"bench: expected seconds of at least 0, got {seconds}")
    if networks:
        with suppress(ModuleNotFoundError):  # torch, which is then said not to be installed
            _require_networks(networks)
    not_run: list[str] = []
    devices = {"cpu": str(describe_platform()["processor"])}
    found: list[Measurement] = []
    if rendering:
        found += _measure_rendering(scene, views, seconds, devices, not_run, progress)
    if networks is None or networks:
        found += _measure_networks(networks, rows, seconds, devices, not_run, progress)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    notes = [
        f"Peak memory of this process: {peak:.0f} MB; load {os.getloadavg()[0]:.1f} at the end.",
        "A training step is a forward pass, the mean square of its outputs, the backward pass and AdamW.",
    ]
    return DeviceBenchmark(devices, describe_platform(), found, not_run, notes)


# -- rendering ---------------------------------------------------------------------------------------------------------


def _measure_rendering(
    scene: str,
    views: Sequence[int] | None,
    seconds: float,
    devices: dict[str, str],
    not_run: list[str],
    progress: Progress,
) -> Iterator[Measurement]:
    """Render views with each available backend."""
    backends = _find_backends(devices, not_run)
    is_fast = "gpu" in backends and "software" not in devices["egl"]
    shrink = 1 if is_fast else SHRINK
    counts = views or (VIEWS if is_fast else FEW_VIEWS)
    if not is_fast:
        sizes = ", ".join(f"{name} {height}x{width}" for name, (height, width) in SIZES.items())
        not_run.append(f"batches of {', '.join(map(str, VIEWS))} views in full size ({sizes}) on an EGL device")
    for backend in backends:
        place = world(scene, backend)
        for kind, (height, width) in SIZES.items():
            size = (height // shrink, width // shrink)
            what = f"{kind} {size[0]}x{size[1]}"
            for count in counts if backend == "gpu" or not is_fast else FEW_VIEWS:
                progress(f"{what}, {count} views, {backend}")
                ms = _time(_prepare_views(place, kind, size, count), lambda: None, seconds)
                yield Measurement(what, devices["egl" if backend == "gpu" else "cpu"], count, "view", ms, None)


def _find_backends(devices: dict[str, str], not_run: list[str]) -> list[Backend]:
    """Return the backends that can render here, and note the EGL device."""
    try:
        usable = [device for device in render.egl_devices() if not device["error"]]
    except BackendError as error:
        not_run.append(f"rendering with EGL: {error}")
        return ["cpu"]
    if not usable:
        not_run.append("rendering with EGL: no device provides an OpenGL context")
        return ["cpu"]
    hardware = [device for device in usable if not device["software"]]
    chosen = (hardware or usable)[0]
    devices["egl"] = f"{chosen['renderer']}, OpenGL {chosen['version']}{'' if hardware else ' (software)'}"
    if not hardware:
        not_run.append(f"rendering with EGL on a hardware device: there is only {devices['egl']}")
    return ["cpu", "gpu"]


def _prepare_views(place: World, kind: str, size: tuple[int, int], count: int) -> Callable[[], Any]:
    """Return a function that renders a batch of views with colour, depth and ids, from places all over a scene."""
    poses = _choose_poses(place, count)
    renderer = place.renderer
    if kind == "panorama":
        buffers = renderer.panorama(poses, size)
        return lambda: renderer.panorama(poses, size, out=buffers)
    buffers = renderer.perspective(poses, size, 90.0)
    return lambda: renderer.perspective(poses, size, 90.0, out=buffers)


def _choose_poses(place: World, count: int) -> NDArray[np.float64]:
    """Return poses [count, 4, 4] a metre above the centres of the floor's triangles, with all headings."""
    triangles = place.navmesh.triangles()[0]
    middles = triangles.mean(axis=1)[np.linspace(0, len(triangles) - 1, count).astype(int)]
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, middle, yaw in zip(poses, middles, np.linspace(0, 2 * np.pi, count, endpoint=False), strict=True):
        pose[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
        pose[:3, 3] = middle + np.array([0.0, 1.0, 0.0])
    return poses


# -- networks ----------------------------------------------------------------------------------------------------------


def _require_networks(names: Sequence[str]) -> None:
    """Refuse a network that is not known.

    Raises:
        ArgumentError: the first one.
        ModuleNotFoundError: torch is not installed.
    """
    from wiw.studies.network_cases import list_cases

    cases = list_cases()
    if unknown := sorted(set(names) - set(cases)):
        raise ArgumentError(f"bench: no network '{unknown[0]}'; expected some of {', '.join(cases)}")


def _measure_networks(
    names: Sequence[str] | None,
    rows: Sequence[int] | None,
    seconds: float,
    devices: dict[str, str],
    not_run: list[str],
    progress: Progress,
) -> Iterator[Measurement]:
    """Roll out and train each network on "cuda", or in small batches on the CPU."""
    try:
        import torch
    except ModuleNotFoundError:
        not_run.append("networks: torch is not installed (pip install 'wiw[torch]')")
        return
    from wiw.studies.network_cases import list_cases

    cases = list_cases()
    has_cuda = torch.cuda.is_available()
    device = "cuda" if has_cuda else "cpu"
    if has_cuda:
        devices["cuda"] = torch.cuda.get_device_name()
    else:
        not_run.append(
            f"networks on CUDA, with batches of {', '.join(map(str, ROWS))}: torch {torch.__version__} sees no device"
        )
    for name in cases if names is None else names:
        for batch in rows or (ROWS if has_cuda else FEW_ROWS):
            progress(f"{name}, {batch} rows, {device}")
            try:
                yield from measure_network(name, batch, device, devices[device], seconds)
            except (Error, RuntimeError) as error:
                not_run.append(f"{name}, {batch} rows on {device}: {str(error).strip().splitlines()[0]}")


def measure_network(name: str, batch: int, device: str, label: str, seconds: float) -> list[Measurement]:
    """Measure a network's rollout and training step on a torch device.

    Args:
        name: of `wiw.studies.network_cases.list_cases`.
        batch: rows.
        device: of torch.
        label: name of the device.
        seconds: that each figure may take.
    """
    import torch

    from wiw.networks import single_thread
    from wiw.studies.network_cases import compute_loss, list_cases

    case = list_cases()[name]
    with torch.device("cpu"):
        network = case.make().to(device)
    with torch.device(device), single_thread():  # as rollouts on the CPU are computed
        torch.manual_seed(0)
        inputs = case.draw(network, batch)
        wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
        network.eval()
        roll_out = case.roll_out or case.call

        @torch.no_grad()
        def imagine() -> None:
            roll_out(network, *inputs)

        found = [Measurement(f"{name} rollout", label, batch, case.unit, *_time_on(device, imagine, wait, seconds))]
        network.train()
        optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE)

        def train() -> None:
            optimizer.zero_grad(set_to_none=True)
            compute_loss(case, network, inputs).backward()
            optimizer.step()

        ms, memory = _time_on(device, train, wait, seconds)
        return [*found, Measurement(f"{name} training step", label, batch, case.unit, ms, memory)]


def _time_on(
    device: str, work: Callable[[], Any], wait: Callable[[], Any], seconds: float
) -> tuple[float, float | None]:
    """Return the milliseconds of a call, and the peak device memory in megabytes."""
    import torch

    if not device.startswith("cuda"):
        return _time(work, wait, seconds), None
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    ms = _time(work, wait, seconds)
    return ms, torch.cuda.max_memory_allocated() / 2**20


def _time(work: Callable[[], Any], wait: Callable[[], Any], seconds: float) -> float:
    """Return the median milliseconds of a call, after a warm-up call; `wait` blocks until the device is done."""
    work()
    wait()
    times: list[float] = []
    while len(times) < LEAST or (sum(times) < seconds and len(times) < MOST):
        begin = time.perf_counter()
        work()
        wait()
        times.append(time.perf_counter() - begin)
    return 1000 * statistics.median(times)
