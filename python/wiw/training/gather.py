# SPDX-License-Identifier: Apache-2.0
"""What is learnt from, of many scenes or plays: kept on disk one by one, so that a command that was stopped goes on."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import blake2b
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import scenes
from wiw.datasets.worlds import world
from wiw.files import whole_file
from wiw.perception.glimpses import Glimpses
from wiw.scenes.store import build_digest
from wiw.training.looks import LookRules, Looks, look_around, merged
from wiw.training.walks import WalkRules, Walks, walk_about
from wiw.training.walks import merged as merged_walks

Arrays = Mapping[str, NDArray[Any]]
Bar = Callable[[Iterable[str], str, int], Iterable[str]]
"""Shows how far an iterable of so many items has come."""


@dataclass(frozen=True)
class Job:
    """What is gathered from each scene, or other source."""

    name: str
    """In words, for bars."""
    fields: tuple[str, ...]
    """Of the arrays that `make` gives."""
    make: Callable[[str], Arrays]
    """Of a source by its name. Runs in other processes: a function of a module, or a `partial` of one."""
    identity: tuple[Any, ...]
    """JSON-able: all that the arrays depend on beside the source, and a version to raise when `make` changes."""


LOOKS = ("images", "boxes", "scalars", "owners", "kinds", "labels")
WALKS = ("images", "distances", "places")


def gathered(
    specs: str, categories: Sequence[str], seed: int, rules: LookRules, folder: Path, workers: int, bar: Bar
) -> Looks:
    """Looks of all scenes of a spec, in their order; those that `folder` does not hold are made by `workers` processes.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: the scenes show nothing of `categories`.
    """
    make = partial(_looks, seed=seed, categories=tuple(categories), rules=rules)
    job = Job(f"looks of {specs}", LOOKS, make, (1, list(categories), seed, asdict(rules)))
    found = gather(_scenes(specs), job, folder, workers, bar)
    parts = [(Glimpses(a["images"], a["boxes"], a["scalars"]), a["owners"], a["kinds"], a["labels"]) for a in found]
    return merged([Looks(*part) for part in parts])


def gathered_walks(specs: str, seed: int, rules: WalkRules, folder: Path, workers: int, bar: Bar) -> Walks:
    """Walks through all scenes of a spec, likewise.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: nowhere in the scenes can one walk straight ahead.
    """
    job = Job(f"walks of {specs}", WALKS, partial(_walks, seed=seed, rules=rules), ("walks", 1, seed, asdict(rules)))
    return merged_walks(
        [Walks(*(a[name] for name in WALKS)) for a in gather(_scenes(specs), job, folder, workers, bar)]
    )


def _scenes(specs: str) -> dict[str, str]:
    """Names of a spec's scenes wherever they are asked for, by their names here."""
    return {name: scenes.absolute(name) for name in scenes.resolve(specs)}


def _looks(name: str, seed: int, categories: Sequence[str], rules: LookRules) -> Arrays:
    looks = look_around(world(name), seed, categories, rules)
    found = looks.glimpses
    values = (found.images, found.boxes, found.scalars, looks.owners, looks.kinds, looks.labels)
    return dict(zip(LOOKS, values, strict=True))


def _walks(name: str, seed: int, rules: WalkRules) -> Arrays:
    walks = walk_about(world(name), seed, rules)
    return {name: getattr(walks, name) for name in WALKS}


def gather(sources: Mapping[str, str], job: Job, folder: Path, workers: int, bar: Bar) -> list[Arrays]:
    """Arrays of all sources, in their order; those that `folder` does not hold are made by `workers` processes.

    Args:
        sources: the name that tells each from all others, by the name that `job.make` takes.
        job: what is made of each.
        folder: where they are kept.
        workers: processes.
        bar: shows how far they have come.

    Raises:
        FileError: the folder cannot be written.
    """
    files = {name: folder / f"{_digest(source, job)}.npz" for name, source in sources.items()}
    found = {name: _read(file, job) for name, file in files.items()}
    missing = [name for name, arrays in found.items() if arrays is None]
    list(bar(_made(missing, files, job, workers), job.name, len(missing)))
    found |= {name: _read(files[name], job) for name in missing}
    return [arrays for arrays in found.values() if arrays is not None]


def _made(names: Sequence[str], files: dict[str, Path], job: Job, workers: int) -> Iterable[str]:
    """Names of scenes as they are done."""
    if workers <= 1 or len(names) <= 1:
        for name in names:
            yield _make(name, files[name], job)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_make, name, files[name], job) for name in names]
        try:
            for each in as_completed(jobs):
                yield each.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _make(name: str, file: Path, job: Job) -> str:
    arrays = job.make(name)
    with whole_file(file) as draft, draft.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    return name


def _read(file: Path, job: Job) -> Arrays | None:
    """None where there is no whole file."""
    try:
        with np.load(file) as values:
            return {name: values[name] for name in job.fields}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _digest(source: str, job: Job) -> str:
    version, *rest = job.identity
    identity = [version, build_digest(), source, *rest]
    return blake2b(json.dumps(identity).encode(), digest_size=12).hexdigest()
