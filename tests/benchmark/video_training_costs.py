# SPDX-License-Identifier: Apache-2.0
"""Seconds and memory of a post-training step of each video world model at its published size, on a CUDA GPU.

Networks have the published sizes (`published_sizes.py`) and random weights, so nothing is downloaded. All else is what
`wiw train NAME` uses: its shipped recipe, its trainable model, its trainer, and panoramas of `wiw collect navigation`,
collected from one apartment first. Not measured: validation, for which training moves the text encoder back to the GPU,
and writing the state.

A step is `batch / rows` passes (clips loaded and encoded, loss, gradients) and one update (clipping, optimiser). Steps
of a few passes are timed, and their parts predict the step of the recipe. Where clips are cached or seen before
(`--cache`), a pass is shorter by the seconds of loading and encoding. Of two experts, the first is measured.

On the GPU are the denoiser in training with its action encoder, gradients and moments, the autoencoder, and the image
encoder if there is one. The text encoder is there until the empty prompt is encoded, the second expert until the first
step; then both are in main memory. What is there until then is "load GB", what is there from then on is "GB".

python tests/benchmark/video_training_costs.py
python tests/benchmark/video_training_costs.py --models wan2.2-5b-action --option optimizer=adamw8bit --out costs.json
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch

sys.path.append(str(Path(__file__).parents[1]))
from published_sizes import PUBLISHED, Published
from video_model_costs import (
    describe_machine,
    first_line,
    format_row,
    free_memory,
    make_network,
    say,
    synchronize,
    time_call,
    write,
)

import tiny_pipelines
from wiw.errors import ArgumentError, DeviceMemoryError
from wiw.networks import memory_guard
from wiw.runs.part_options import parse_options
from wiw.training.collect_navigation import collect_navigation
from wiw.training.post_training.corpora import Corpus, open_corpus
from wiw.training.post_training.families import FAMILIES, PretrainedWeights, VideoFamily
from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
from wiw.training.post_training.train import choose_precision, list_remedies
from wiw.training.post_training.trainer import PostTrainer, encode_clip
from wiw.world_models.video import loading
from wiw.world_models.video.actions.model import ActionConditioned

RECIPES = {f"{name}-action": name for name in PUBLISHED if f"{name}-action" in FAMILIES}
"""Post-trained models, the cheap ones first, and the generators that they are trained from."""
SCENES = ("apartments:train:1",)
PASSES, STEPS = 2, 3
"""Passes of a timed step, and timed steps after the first one."""
BUDGET = 500.0
COLUMNS = (
    "params B",
    "trained B",
    "rows",
    "passes",
    "encode s",
    "pass s",
    "update s",
    "step s",
    "s/clip",
    "clips/h",
    "GB",
    "load GB",
    "made in s",
)


@dataclass(frozen=True)
class TrainingCost:
    """Cost of one step of one recipe."""

    model: str
    recipe: dict[str, Any]
    """As it is trained with; what follows is about it unless it says "timed"."""
    billions: float
    """Parameters of the denoiser in training, its LoRA and its action encoder included."""
    billions_trained: float
    """The trained ones among them."""
    precisions: dict[str, str]
    passes: int
    passes_timed: int
    seconds_loading: float
    """Reading and decoding a clip, and bringing it to the GPU."""
    seconds_encoding: float
    """Encoding that clip with the frozen networks."""
    seconds_first: float
    """The first timed step, in which libraries choose kernels and the optimiser makes its moments."""
    seconds_timed: list[float]
    """The timed steps after it."""
    seconds_per_pass: float
    """Mean over passes of `rows` clips, loading and encoding included."""
    seconds_per_update: float
    """Clipping the gradient and the optimiser's step: a timed step less its passes; mean."""
    seconds_per_step: float
    """Predicted."""
    seconds_per_clip: float
    """Predicted: that step over its clips."""
    clips_per_hour: float
    loss: float
    """Loss of the last step."""
    gigabytes: float | None
    """Most memory of the GPU in tensors while it encodes and trains, weights included."""
    gigabytes_reserved: float | None
    """The same in what torch has taken from the GPU."""
    gigabytes_held: float | None
    """In tensors before the first step: without gradients and moments."""
    gigabytes_loading: float | None
    """Most in tensors while the model is made."""
    seconds_making: float

    def format(self) -> str:
        """Return the row of the table."""
        rows = str(self.recipe["rows"])
        counts = [f"{self.billions:.2f}", f"{self.billions_trained:.3f}", rows, str(self.passes)]
        seconds = [self.seconds_encoding, self.seconds_per_pass, self.seconds_per_update, self.seconds_per_step]
        memory = [self.gigabytes, self.gigabytes_loading, self.seconds_making]
        cells = [*map(format_number, [*seconds, self.seconds_per_clip]), f"{self.clips_per_hour:.0f}"]
        return format_row(shorten(self.model), [*counts, *cells, *map(format_number, memory)])


class TimedTrainer(PostTrainer):
    """Train, and keep the seconds of each pass."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.seconds: list[float] = []

    def _add_gradients(self, *arguments: Any) -> float:
        add = partial(super()._add_gradients, *arguments)
        seconds, loss = time_call(str(self.device), add)
        self.seconds.append(seconds)
        return loss


def format_number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def shorten(name: str) -> str:
    return name.removesuffix("-action")


def collect(folder: Path, size: tuple[int, int] | None = None) -> Path:
    """Collect panoramas from one apartment; of the size of datasets unless another is given."""
    collect_navigation(folder, SCENES, depth=False, size=size)
    return folder


@contextmanager
def replace_networks(model: type[ActionConditioned], published: Published) -> Iterator[None]:
    """Have a model's generator come with the published networks and scheduler as long as the context lasts.

    The precisions are those that its recipe loads weights in.
    """
    stock = model.generator_class

    def components(generator: Any) -> dict[str, Any]:
        kinds = loading._choose_dtypes(generator)
        networks = {
            place: make_network(build, generator.device, kinds.get(place, kinds["default"]))
            for place, build in published.networks.items()
        }
        return {**stock.components(generator), "scheduler": published.scheduler(), **networks}

    changed = type(stock.__name__, (stock,), {"components": components, "__doc__": stock.__doc__})
    with mock.patch.object(model, "generator_class", changed):
        yield


def make_trainer(
    family: VideoFamily, published: Published, corpus: Corpus, recipe: PostTrainingRecipe, device: str
) -> TimedTrainer:
    """Make a trainer as `wiw train` does, with the published networks; only what its first step trains is kept."""
    with tempfile.TemporaryDirectory() as folder, replace_networks(family.model, published):
        with loading._hide_progress_bars():
            weights = tiny_pipelines.save(shorten(family.world_model), Path(folder))
        loaded = family.load(corpus, recipe, PretrainedWeights(str(weights), device=device))
    trainer = TimedTrainer(loaded.model, corpus.clips(loaded.recipe.frames), loaded.recipe)
    trainer.select_batch()
    return trainer


def abridge(recipe: PostTrainingRecipe, passes: int, steps: int) -> PostTrainingRecipe:
    """Return the recipe with steps of so many passes, on the clips of one step, and one step before those that count.

    The epochs keep all steps with the first of two experts.
    """
    clips = passes * recipe.rows
    return replace(recipe, batch=clips, clips=clips, epochs=1 + steps)


def measure(
    name: str,
    published: Published,
    data: Path,
    device: str = "cuda",
    passes: int = PASSES,
    steps: int = STEPS,
    options: Mapping[str, Any] | None = None,
) -> TrainingCost:
    """Make a model ready for training and measure steps of it.

    Args:
        name: of the model, such as "ltx-action".
        published: networks and scheduler of its generator.
        data: folder of `wiw collect navigation`.
        device: "cuda" or "cpu".
        passes: of a timed step, at most those of the recipe.
        steps: to time, after a first one.
        options: of the recipe, on top of the shipped one.
    """
    family = FAMILIES[name]
    assert isinstance(family, VideoFamily)
    recipe = choose_precision(load_recipe(name, options=options), device)
    corpus, recipe = family.fit(open_corpus(data, "all"), recipe)
    passes = min(passes, recipe.batch // recipe.rows)
    reset_peak(device)
    with memory_guard(f"training {name} on {device}", "; ".join(list_remedies(recipe))):
        make = partial(make_trainer, family, published, corpus, abridge(recipe, passes, steps), device)
        making, trainer = time_call(device, make)
        made = {"gigabytes_loading": read_peak(device), "seconds_making": making}
        free_memory()
        reset_peak(device)
        made["gigabytes_held"] = read_peak(device)
        clip = time_clip(trainer, device)
        timed = time_steps(trainer, device, steps)
    trained = trainer.recipe
    recipe = replace(recipe, frames=trained.frames, size=trained.size)
    return TrainingCost(
        model=name,
        recipe=recipe.describe(),
        passes=recipe.batch // recipe.rows,
        passes_timed=passes,
        loss=trainer.mean_loss,
        gigabytes=read_peak(device),
        gigabytes_reserved=torch.cuda.max_memory_reserved() / 1e9 if device == "cuda" else None,
        **describe_networks(trainer, published),
        **made,
        **clip,
        **timed,
        **predict(timed["seconds_per_pass"], timed["seconds_per_update"], recipe),
    )


def time_clip(trainer: PostTrainer, device: str) -> dict[str, float]:
    """Return the seconds of loading and encoding a clip, each the second time."""
    index = int(trainer.select_batch()[0])
    load = partial(trainer._load_clip, index, False)
    load()
    loading_seconds, clip = time_call(device, load)
    encode = partial(encode_clip, trainer.model, clip)
    encode()
    return {"seconds_loading": loading_seconds, "seconds_encoding": time_call(device, encode)[0]}


def time_steps(trainer: TimedTrainer, device: str, steps: int) -> dict[str, Any]:
    """Return the seconds of the first step, of the steps after it, and means of what those consist of."""
    step = partial(trainer.train_step, trainer.recipe.rate)
    first = time_call(device, step)[0]
    trainer.seconds.clear()
    seconds = [time_call(device, step)[0] for _ in range(steps)]
    return {
        "seconds_first": first,
        "seconds_timed": seconds,
        "seconds_per_pass": sum(trainer.seconds) / len(trainer.seconds),
        "seconds_per_update": (sum(seconds) - sum(trainer.seconds)) / steps,
    }


def predict(one_pass: float, update: float, recipe: PostTrainingRecipe) -> dict[str, float]:
    """Return the seconds of a step of a recipe, and what follows for its clips."""
    step = recipe.batch // recipe.rows * one_pass + update
    per_clip = step / recipe.batch
    return {"seconds_per_step": step, "seconds_per_clip": per_clip, "clips_per_hour": 3600 / per_clip}


def describe_networks(trainer: PostTrainer, published: Published) -> dict[str, Any]:
    """Return how large what is trained is, and the precision of each network's parameters."""
    place, pipeline = trainer.model.places[0], trainer.model.objective.pipeline
    trained = trainer.model.list_trained(place)
    parts = [*getattr(pipeline, place).parameters(), *trainer.model.encoders[place].parameters()]
    return {
        "billions": sum(each.numel() for each in parts) / 1e9,
        "billions_trained": sum(each.numel() for each in trained.values()) / 1e9,
        "precisions": {each: list_precisions(pipeline.components[each]) for each in published.networks},
    }


def list_precisions(network: torch.nn.Module) -> str:
    return ", ".join(sorted({str(each.dtype).removeprefix("torch.") for each in network.parameters()}))


def reset_peak(device: str) -> None:
    synchronize(device)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()


def read_peak(device: str) -> float | None:
    """Return the most gigabytes of the GPU in tensors since the last reset; None for the CPU."""
    return torch.cuda.max_memory_allocated() / 1e9 if device == "cuda" else None


def attempt(name: str, published: Published, **options: Any) -> tuple[str, dict[str, Any]]:
    """Return the row of a model and its record; of an error, its first line and the memory until then."""
    try:
        cost = measure(name, published, **options)
    except (DeviceMemoryError, torch.OutOfMemoryError) as error:
        said = f"does not fit: {first_line(error)}"
    except Exception as error:
        said = first_line(error)
    else:
        return cost.format(), asdict(cost)
    record = {"model": name, "options": dict(options.get("options") or {}), "error": said}
    return f"{shorten(name):16}  {said}", record | {"gigabytes": read_peak(options.get("device", "cuda"))}


def run(names: Sequence[str], budget: float, out: Path | None, sizes: Mapping[str, Published], **options: Any) -> None:
    """Measure models one after the other, printing each row and writing the records as soon as they are known."""
    start, records = time.perf_counter(), []
    say(format_row("trained", COLUMNS))
    for index, name in enumerate(names):
        if time.perf_counter() - start >= budget:
            say(f"not run, since {budget:g} s are used: {', '.join(names[index:])}")
            break
        row, record = attempt(name, sizes[RECIPES[name]], **options)
        free_memory()
        records.append(record)
        say(row)
        write(out, records, names[index + 1 :])
    say(f"{time.perf_counter() - start:.0f} s in all")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", default=",".join(RECIPES), help="names with commas between them")
    parser.add_argument("--budget", type=float, default=BUDGET, help="seconds after which no model is started")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    parser.add_argument("--data", type=Path, help="panoramas of `wiw collect navigation`; collected if not given")
    parser.add_argument("--passes", type=int, default=PASSES, help="passes of a timed step")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps to time after the first one")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help="of all recipes")
    given = parser.parse_args()
    given.names = given.models.split(",")
    if unknown := [name for name in given.names if name not in RECIPES]:
        parser.error(f"unknown {', '.join(unknown)}: choose from {', '.join(RECIPES)}")
    if min(given.passes, given.steps) < 1:
        parser.error("--passes, --steps: expected 1 or more")
    try:
        given.options = parse_options(given.option, PostTrainingRecipe, "--option")
    except ArgumentError as error:
        parser.error(str(error))
    return given


def main() -> int:
    given = parse()
    if not torch.cuda.is_available():
        say("no CUDA GPU: nothing is measured")
        return 2
    machine = describe_machine() | given.options
    say(", ".join(f"{name} {value}" for name, value in machine.items()))
    names = sorted(given.names, key=list(RECIPES).index)
    choices = {"passes": given.passes, "steps": given.steps, "options": given.options}
    with tempfile.TemporaryDirectory() as folder:
        data = given.data or collect(Path(folder) / "data")
        run(names, given.budget, given.out, PUBLISHED, data=data, **choices)
    return 0


if __name__ == "__main__":
    sys.exit(main())
