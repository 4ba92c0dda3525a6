# SPDX-License-Identifier: Apache-2.0
"""Looks of many scenes: kept on disk scene by scene, so that a command that was stopped goes on where it was."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from hashlib import blake2b
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from wiw import scenes
from wiw.datasets.worlds import world
from wiw.errors import FileError
from wiw.perception.glimpses import Glimpses
from wiw.scenes.store import build_digest
from wiw.training.looks import LookRules, Looks, look_around, merged

FIELDS = ("images", "boxes", "scalars", "owners", "kinds", "labels")
VERSION = 1
"""Of what is looked at and how; raise it when `looks` or `glimpses` give something else."""

Bar = Callable[[Iterable[str], str, int], Iterable[str]]
"""Shows how far an iterable of so many items has come."""


def gathered(
    specs: str, categories: Sequence[str], seed: int, rules: LookRules, folder: Path, workers: int, bar: Bar
) -> Looks:
    """Looks of all scenes of a spec, in their order; those that `folder` does not hold are made by `workers` processes.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: the scenes show nothing of `categories`.
    """
    names = scenes.resolve(specs)
    files = {name: folder / f"{_digest(name, categories, seed, rules)}.npz" for name in names}
    missing = [name for name in names if _read(files[name]) is None]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        list(bar(_made(missing, files, categories, seed, rules, workers), f"looks of {specs}", len(missing)))
    except OSError as error:
        raise FileError(f"{folder}: cannot be written ({error.strerror}); choose another with --cache") from error
    found = [_read(files[name]) for name in names]
    return merged([looks for looks in found if looks is not None])


def _made(
    names: Sequence[str],
    files: dict[str, Path],
    categories: Sequence[str],
    seed: int,
    rules: LookRules,
    workers: int,
) -> Iterable[str]:
    """Names of scenes as they are done."""
    if workers <= 1 or len(names) <= 1:
        for name in names:
            yield _make(name, files[name], categories, seed, rules)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_make, name, files[name], categories, seed, rules) for name in names]
        try:
            for job in as_completed(jobs):
                yield job.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _make(name: str, file: Path, categories: Sequence[str], seed: int, rules: LookRules) -> str:
    looks = look_around(world(name), seed, categories, rules)
    found = looks.glimpses
    values = (found.images, found.boxes, found.scalars, looks.owners, looks.kinds, looks.labels)
    part = file.with_name(f"{file.stem}.{os.getpid()}.part")
    with part.open("wb") as stream:
        np.savez(stream, **dict(zip(FIELDS, values, strict=True)))  # type: ignore[arg-type]
    part.replace(file)
    return name


def _read(file: Path) -> Looks | None:
    """None where there is no whole file."""
    try:
        with np.load(file) as values:
            images, boxes, scalars, owners, kinds, labels = (values[name] for name in FIELDS)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return Looks(Glimpses(images, boxes, scalars), owners, kinds, labels)


def _digest(name: str, categories: Sequence[str], seed: int, rules: LookRules) -> str:
    identity = [VERSION, build_digest(), scenes.absolute(name), list(categories), seed, asdict(rules)]
    return blake2b(json.dumps(identity).encode(), digest_size=12).hexdigest()
