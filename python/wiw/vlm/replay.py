# SPDX-License-Identifier: Apache-2.0
"""Replay of answers that a run has recorded."""

from __future__ import annotations

import inspect
import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from wiw.errors import FileError, VlmError
from wiw.vlm.base import Client
from wiw.vlm.messages import Call, Completion


class ReplayClient(Client):
    """Stands in for the model of a run: questions asked then get their recorded answer, and others an error.

    Args:
        run: the run's folder, or its run.sqlite.
        model: the recorded model; None means the only one in the run.
        options: see `Client`; those of other clients are accepted and ignored.

    Raises:
        FileError: no run there, or one without recorded answers, or with several models and none is named.
    """

    def __init__(self, run: str | Path, model: str | None = None, **options: Any) -> None:
        known = inspect.signature(Client).parameters
        super().__init__(**{name: value for name, value in options.items() if name in known})
        path = Path(run).expanduser()
        self.path = path if path.suffix == ".sqlite" else path / "run.sqlite"
        self._answers, models = _read_answers(self.path, model)
        if not models or (model is None and len(models) > 1):
            raise FileError(f"{self.path}: expected answers of one model, got {', '.join(sorted(models)) or 'none'}")
        self._model = model or models.pop()

    @property
    def model(self) -> str:
        """The model that gave these answers."""
        return self._model

    def complete(self, calls: Sequence[Call]) -> list[Completion]:
        """Return the recorded answers.

        Raises:
            VlmError: a question that the run did not ask.
        """
        names = [self.name_of(call) for call in calls]
        for name, call in zip(names, calls, strict=True):
            if name not in self._answers:
                begin = next((part for part in call.messages[-1].content if isinstance(part, str)), "")[:80]
                raise VlmError(f"{self.path} has no answer to this question ({name}): '{begin}...'", "missing")
        return [self._answers[name] for name in names]


def _read_answers(path: Path, model: str | None) -> tuple[dict[str, Completion], set[str]]:
    if not path.is_file():
        raise FileError(f"no run at {path}: expected a folder with run.sqlite in it")
    answers: dict[str, Completion] = {}
    models: set[str] = set()
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
            rows = connection.execute("SELECT exchanges FROM decision WHERE exchanges != '[]'").fetchall()
        for exchange in (exchange for (text,) in rows for exchange in json.loads(text)):
            if model in (None, exchange["model"]):
                models.add(exchange["model"])
                answers |= {said["call"]: Completion.from_json(said) for said in exchange["said"]}
    except (sqlite3.Error, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{path}: the recorded answers cannot be read: {error}") from error
    return answers, models
