# SPDX-License-Identifier: Apache-2.0
"""Train a small world model, pocket or warpnet, on a navigation dataset, or resume, and write its weights."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wiw
from wiw.datasets.navigation import NavigationData, Part
from wiw.errors import ArgumentError, WeightsError
from wiw.files import atomic_file
from wiw.networks import describe_device, memory_guard, resolve_device
from wiw.training.checkpoint import locate_checkpoint
from wiw.training.held_out_clips import Frames, Imagine, imagine_with
from wiw.training.learners import Learner, make_learner
from wiw.training.place_trainer import PlaceTrainer
from wiw.training.post_training.clip_trainer import arrange_clips
from wiw.training.post_training.corpora import NavigationCorpus, require_panoramas, require_training_split
from wiw.training.post_training.recipe import ClipRecipe
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.post_training.train import locate_log, train_and_validate
from wiw.training.post_training.training_log import require_own_log
from wiw.training.post_training.validation import (
    CARD,
    OnValidation,
    ValidatedTrainer,
    build_validation_set,
    find_held_out,
)
from wiw.training.reduced_frames import Bar, reduce_frames
from wiw.training.save_signal import hold_save_signal
from wiw.types import Conditioning

BEST = "weights.safetensors"
"""Name of the best weights so far, in the log's folder."""


@hold_save_signal()
def train_on_clips(
    name: str,
    data: str | Path,
    out: Path,
    cache: Path,
    recipe: ClipRecipe,
    part: Part = "train",
    validation: str | Path | None = None,
    decisions: str | Path | None = None,
    tracker: str | None = None,
    device: str | None = None,
    seconds: float = 600.0,
    on_step: Callable[[int, int, float], None] = lambda *_: None,
    on_validation: OnValidation = lambda *_: None,
    bar: Bar = lambda items, text, total: items,
) -> dict[str, Any]:
    """Train, or resume, and write the file of weights: the best in validation, or the last without it.

    A state is kept beside `out`, in `OUT.checkpoint`, every so often, at SIGUSR1, and before the process stops at
    SIGTERM or Ctrl-C. The same call resumes from it; on the CPU, with the same number of threads, it ends with the same
    bytes.
    Once it has written `out`, it trains no more and returns that file's card.
    `OUT.log` has the loss of each step and what validations found.

    Args:
        name: of the world model, one of `wiw.training.learners.LEARNERS`.
        data: folder of `wiw collect navigation`, of panoramas.
        out: file of the weights.
        cache: folder of frames in the recipe's size, which are made once.
        recipe: the numbers.
        part: of the dataset: "train", which leaves a share of the scenes for validation, or "all".
        validation: folder of another dataset whose clips it is validated on; the scenes left out if None.
        decisions: file of `wiw collect decisions`, for the rank agreement with the oracle.
        tracker: "trackio", "wandb" or "tensorboard", which receives the log.
        device: of torch, for training; "cuda" if there is one, else "cpu". Models imagine on the CPU in any case.
        seconds: least time between two writes of the state.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        on_validation: called after each validation with the number of steps done and what was found.
        bar: shows the progress of decoding.

    Returns:
        The card in the file: data, recipe, steps, validation and the loss at the end.

    Raises:
        ArgumentError: an unknown model or device; a dataset of perspective views, of scenes for evaluation or, for
            warpnet, without depth; too few clips; a state of a training with other data or numbers; weights in `out`
            that another training has written; files of others in the folder of the log; or validation or decisions on
            scenes that are trained on or not there.
        TrainingError: the loss is not finite; the last good state is kept, the message names the batch.
        FileError: the dataset is missing, incomplete or damaged, or a file cannot be written.
        DeviceMemoryError: memory does not suffice.
        DependencyError: torch or safetensors is not installed.
    """
    learner, device = make_learner(name), resolve_device(device)

    def open_part(folder: str | Path, wanted: Part) -> NavigationCorpus:
        found = NavigationCorpus(NavigationData(folder, wanted, recipe.held_out), wanted)
        require_panoramas(name, found)
        return found

    corpus = open_part(data, part)
    require_training_split(corpus)
    dataset = corpus.data
    learner.trainer.check_dataset(dataset)
    clips = dataset.clips(recipe.frames)
    arrange_clips(len(clips), recipe)
    held_out, checked = find_held_out(open_part, corpus, validation, decisions, recipe), None
    if held_out is not None:
        chosen = held_out.select_clips(recipe.frames, recipe.validate_clips, recipe.seed, recipe.clip_size)
        checked = build_validation_set(held_out, chosen, decisions, recipe)
    card: dict[str, Any] = {"wiw": wiw.__version__, "data": corpus.describe(), "recipe": recipe.describe()}
    card |= {"validated_on": checked.identity if checked else None}
    if out.exists():
        return _read_finished(learner, out, card)
    require_own_log(locate_log(out), out.name, locate_checkpoint(out).exists())
    frames = reduce_frames(dataset, recipe.clip_size, cache, bar)
    state = SignalledCheckpoint(locate_checkpoint(out), {"model": name, **card}, seconds)
    remedies = f"lower batch (now {recipe.batch}), or choose a smaller size or network"
    with memory_guard(f"training {name} on {device}", remedies):
        trainer = learner.trainer(clips, frames, recipe, device)
        validated = train_and_validate(
            trainer,
            create_sampler(learner, trainer),
            checked,
            out,
            lambda best, found: _save_best(learner, best, trainer, found),
            state,
            tracker,
            on_step,
            on_validation,
        )
    card |= {"trained_steps": trainer.step_count, "loss": trainer.mean_loss, "device": describe_device(device)}
    card = _publish_weights(learner, out, validated, trainer, card)
    state.remove()
    return card


def create_sampler(learner: Learner, trainer: PlaceTrainer) -> Imagine:
    """Return how the network in training imagines on the CPU, with its averaged weights if there are any."""
    shown = copy.deepcopy(trainer.network).cpu()
    imagine = imagine_with(learner.model.of(shown))

    def imagine_now(
        observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        with trainer.use_averages():
            shown.load_state_dict(trainer.network.state_dict())
        return imagine(observations, plans, seeds, wanted)

    return imagine_now


def _read_finished(learner: Learner, out: Path, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the card of weights that the same training has written.

    Raises:
        ArgumentError: it was another one, or the file has no such weights.
    """
    try:
        card = learner.load(out)[1]
    except WeightsError as error:
        raise ArgumentError(
            f"{out} exists and would be replaced: choose another file, or delete it ({error})"
        ) from error
    others = [name for name, value in json.loads(json.dumps(identity)).items() if card.get(name) != value]
    if others:
        raise ArgumentError(
            f"{out} has the weights of another training (of other {', '.join(others)}), which would be replaced; "
            "choose another file, or delete it"
        )
    return card


def _save_best(learner: Learner, folder: Path, trainer: PlaceTrainer, found: Mapping[str, Any]) -> None:
    with trainer.use_averages():
        learner.save(folder / BEST, trainer.network, found)
    with atomic_file(folder / CARD) as draft:
        draft.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


def _publish_weights(
    learner: Learner, out: Path, validated: ValidatedTrainer, trainer: PlaceTrainer, card: Mapping[str, Any]
) -> dict[str, Any]:
    """Write the best weights in validation, or the last ones without it; return their card."""
    if not validated.best.exists():
        found = {**card, "steps": trainer.step_count}
        with trainer.use_averages():
            learner.save(out, trainer.network, found)
        return found
    network, own = learner.load(validated.best / BEST)
    found = {**card, **own}
    learner.save(out, network, found)
    shutil.rmtree(validated.best)
    return found
