# SPDX-License-Identifier: Apache-2.0
"""Seconds and memory of one rollout of each video world model at its published size, on a CUDA GPU.

Networks have the published sizes (`published_sizes.py`) and random weights, on whose values cost does not depend, so
nothing is downloaded. Sizes, frames, steps, guidance and precisions are the defaults of `wiw run`, and it is `rollout`
that is timed, for one row. Two rollouts of few steps tell seconds per step from the fixed rest (text, codec); those
predict the rollout at the default steps, which is timed too where it is short.

python tests/benchmark/video_model_costs.py
python tests/benchmark/video_model_costs.py --models svd,ltx --budget 100 --out costs.json
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from accelerate import init_empty_weights
from diffusers import ModelMixin

sys.path.append(str(Path(__file__).parents[1]))
from published_sizes import PUBLISHED, Published

import tiny_pipelines
from wiw import action
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import DeviceMemoryError
from wiw.registry import WORLD_MODELS
from wiw.types import Conditioning, Control
from wiw.world_models.video import loading

FEW, MORE = 2, 6
"""Steps of the two rollouts that tell a step's seconds."""
SHORT = 20.0
"""Predicted seconds up to which the rollout at the default steps is timed too."""
BUDGET = 200.0
PLAN = (FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD, TURN_RIGHT, FORWARD)
SPREAD = 0.02
"""Standard deviation of weights; less where a layer sums so many inputs that values would grow."""
COLUMNS = ("params B", "size", "frames", "steps", "s/step", "rest s", "s/rollout", "timed s", "GB", "made in s")
T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """Cost of one rollout of one row."""

    model: str
    billions: float
    """Parameters of the denoiser, of both where there are two experts."""
    parameters: dict[str, int]
    """Parameters of each network."""
    precisions: dict[str, str]
    size: tuple[int, int]
    frames: int
    steps: int
    seconds_per_step: float
    seconds_rest: float
    seconds_per_rollout: float
    """Predicted at the default steps."""
    seconds_timed: float | None
    """Measured at the default steps, where that is short."""
    gigabytes: float | None
    """Most memory of the GPU in tensors during a rollout, weights included."""
    seconds_making: float

    def format(self) -> str:
        """Return the row of the table."""
        shape = [f"{self.billions:.2f}", "x".join(map(str, self.size)), str(self.frames), str(self.steps)]
        seconds = (self.seconds_per_step, self.seconds_rest, self.seconds_per_rollout, self.seconds_timed)
        rest = [*seconds, self.gigabytes, self.seconds_making]
        return format_row(self.model, [*shape, *("-" if value is None else f"{value:.3f}" for value in rest)])


def format_row(name: str, cells: Sequence[str]) -> str:
    return f"{name:16}" + "".join(f"{cell:>11}" for cell in cells)


@contextmanager
def default_type(kind: torch.dtype) -> Iterator[None]:
    """Make parameters of this type, as `from_pretrained` does."""
    usual = torch.get_default_dtype()
    torch.set_default_dtype(kind)
    try:
        yield
    finally:
        torch.set_default_dtype(usual)


def make_network(build: Callable[[], Any], device: str, kind: torch.dtype) -> Any:
    """Make a network with random weights on the device; its buffers are those that it computes itself."""
    with default_type(kind), init_empty_weights(include_buffers=False):
        network = build()
    if hasattr(network, "tie_weights"):
        network.tie_weights()
    draw_weights(network, device, list_whole_parts(network, kind))
    return network.to(device).eval().requires_grad_(False)


def list_whole_parts(network: Any, kind: torch.dtype) -> tuple[str, ...]:
    """Return the names of parts that the libraries keep in float32 in half precision; transformers only in float16."""
    halved = kind == torch.float16 or (kind == torch.bfloat16 and isinstance(network, ModelMixin))
    return tuple(network._keep_in_fp32_modules or ()) if halved else ()


def draw_weights(network: torch.nn.Module, device: str, whole: Sequence[str] = ()) -> None:
    """Give each parameter memory and values; parts in `whole` become float32, shared parameters stay shared."""
    drawn: dict[torch.nn.Parameter, torch.nn.Parameter] = {}
    for path, module in network.named_modules():
        for name, parameter in list(module._parameters.items()):
            if parameter is None:
                continue
            if parameter not in drawn:
                parts = {*path.split("."), name}
                kind = torch.float32 if parts.intersection(whole) else parameter.dtype
                value = torch.empty(parameter.shape, device=device, dtype=kind)
                drawn[parameter] = torch.nn.Parameter(fill(name, value), requires_grad=False)
            module._parameters[name] = drawn[parameter]


def fill(name: str, value: torch.Tensor) -> torch.Tensor:
    """Fill a parameter: scales of norms with 1, biases with 0, the rest at random."""
    if name == "gamma" or (name == "weight" and value.ndim == 1):
        return value.fill_(1)
    if name == "bias":
        return value.zero_()
    inputs = value[0].numel() if value.ndim > 1 else 1
    return value.normal_(0, min(SPREAD, inputs**-0.5))


def make_model(name: str, published: Published, folder: Path, **options: Any) -> Any:
    """Make a world model from a tiny pipeline's folder with the published networks and scheduler in their places."""

    def load(model: Any) -> dict[str, Any]:
        kinds = loading._choose_dtypes(model)
        return {
            "scheduler": published.scheduler(),
            **{
                place: make_network(build, model.device, kinds.get(place, kinds["default"]))
                for place, build in published.networks.items()
            },
        }

    with loading._hide_progress_bars():
        weights = tiny_pipelines.save(name, folder)
    return WORLD_MODELS.find(name).with_networks(load, weights=str(weights), **{**published.options, **options})


def imagine(model: Any, steps: int) -> np.ndarray:
    """Return the frames of one rollout of one row."""
    model.steps = steps
    plan = PLAN[: model.accepts.frames - 1]
    padded = action.pad(plan, model.accepts.frames - 1)
    views = action.to_trajectory(padded), action.to_viewpoints(padded)
    control = Control(padded, *views, action.to_text(plan), length=len(plan))
    picture = np.random.default_rng(0).integers(0, 256, (1, *model.size, 3), np.uint8)
    return model.rollout(Conditioning(picture), [control], np.array([7], np.uint64))


def time_call(device: str, call: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds of a call until the device has finished, and what it returned."""
    synchronize(device)
    start = time.perf_counter()
    result = call()
    synchronize(device)
    return time.perf_counter() - start, result


def synchronize(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def measure(name: str, published: Published, device: str = "cuda", short: float = SHORT, **options: Any) -> Cost:
    """Make a world model and measure its rollouts.

    Args:
        name: of the world model.
        published: networks and scheduler.
        device: "cuda" or "cpu".
        short: predicted seconds up to which the rollout at the default steps is timed too.
        options: of the world model; its defaults otherwise.
    """
    with tempfile.TemporaryDirectory() as folder:
        make = partial(make_model, name, published, Path(folder), device=device, **options)
        making, model = time_call(device, make)
    steps = model.steps
    networks = {place: model.pipeline.components[place] for place in published.networks}
    parameters = {place: sum(each.numel() for each in network.parameters()) for place, network in networks.items()}
    imagine(model, FEW)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    few, more = (time_call(device, partial(imagine, model, count))[0] for count in (FEW, MORE))
    step = (more - few) / (MORE - FEW)
    rest = few - FEW * step
    predicted = rest + steps * step
    timed = time_call(device, partial(imagine, model, steps))[0] if predicted < short else None
    return Cost(
        model=name,
        billions=sum(parameters[place] for place in published.denoisers) / 1e9,
        parameters=parameters,
        precisions={place: str(network.dtype).removeprefix("torch.") for place, network in networks.items()},
        size=model.size,
        frames=model.frames,
        steps=steps,
        seconds_per_step=step,
        seconds_rest=rest,
        seconds_per_rollout=predicted,
        seconds_timed=timed,
        gigabytes=torch.cuda.max_memory_allocated() / 1e9 if device == "cuda" else None,
        seconds_making=making,
    )


def attempt(name: str, published: Published, **options: Any) -> tuple[str, dict[str, Any]]:
    """Return the row of a model and its record; of an error, its first line."""
    try:
        cost = measure(name, published, **options)
    except (DeviceMemoryError, torch.OutOfMemoryError) as error:
        said = f"does not fit: {first_line(error)}"
    except Exception as error:
        said = first_line(error)
    else:
        return cost.format(), asdict(cost)
    return f"{name:16}  {said}", {"model": name, "error": said}


def first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def free_memory() -> None:
    """Return the memory of a model that nothing refers to any more."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def run(names: Sequence[str], budget: float, out: Path | None, sizes: dict[str, Published], **options: Any) -> None:
    """Measure models one after the other, printing each row and writing the records as soon as they are known."""
    start, records = time.perf_counter(), []
    say(format_row("model", COLUMNS))
    for index, name in enumerate(names):
        left = budget - (time.perf_counter() - start)
        if left <= 0:
            say(f"not run, since {budget:g} s are used: {', '.join(names[index:])}")
            break
        row, record = attempt(name, sizes[name], short=min(SHORT, left), **options)
        free_memory()
        records.append(record)
        say(row)
        write(out, records, names[index + 1 :])
    say(f"{time.perf_counter() - start:.0f} s in all")


def write(out: Path | None, records: Sequence[dict[str, Any]], waiting: Sequence[str]) -> None:
    if out is not None:
        content = {"machine": describe_machine(), "models": records, "not_run": list(waiting)}
        out.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def describe_machine() -> dict[str, str]:
    """Return the GPU and the versions of what runs on it."""
    import diffusers
    import transformers

    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    versions = {module.__name__: module.__version__ for module in (torch, diffusers, transformers)}
    return {"gpu": gpu, "python": platform.python_version(), **versions}


def say(line: str) -> None:
    print(line, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", default=",".join(PUBLISHED), help="names with commas between them")
    parser.add_argument("--budget", type=float, default=BUDGET, help="seconds after which no model is started")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    given = parser.parse_args()
    names = given.models.split(",")
    if unknown := [name for name in names if name not in PUBLISHED]:
        parser.error(f"unknown {', '.join(unknown)}: choose from {', '.join(PUBLISHED)}")
    if not torch.cuda.is_available():
        say("no CUDA GPU: nothing is measured")
        return 2
    say(", ".join(f"{name} {value}" for name, value in describe_machine().items()))
    run(sorted(names, key=list(PUBLISHED).index), given.budget, given.out, PUBLISHED)
    return 0


if __name__ == "__main__":
    sys.exit(main())
